"""The area of an artifact that changes from photo to photo, as a weapon does that sways by a few pixels.

One transmittance and one color are true of none of its photos, so the scene would learn what they leave unexplained.
"""

from __future__ import annotations

import cv2
import numpy as np

from ssa_nerfstudio.evidence.layer_estimate import MIN_OPACITY, LayerEstimate

USUAL = 0.99
"""Quantile of the clear pixels: where a larger share of the samples is unexplained than there, it is unusual."""
MIN_MEAN_OPACITY = 0.5
"""An unusual area is an artifact's if it hides half of the scene: shading and reflections on an object that stays in
the middle of the frame hide a quarter, a weapon three quarters."""
_NEIGHBORS = np.ones((3, 3), np.uint8)


def changing_area(estimate: LayerEstimate) -> np.ndarray:
    """Where an artifact changes: bool [h, w], of the working size, two pixels wider than what is found."""
    opacity, unexplained = (x[..., 0].cpu().numpy() for x in (estimate.opacity(), estimate.unexplained))
    clear = opacity <= MIN_OPACITY
    usual = unexplained[clear & ~np.isnan(unexplained)]
    if not usual.size:
        return np.zeros_like(clear)
    unusual = ~clear & (unexplained > np.quantile(usual, USUAL))
    opened = cv2.morphologyEx(unusual.astype(np.uint8), cv2.MORPH_OPEN, _NEIGHBORS)
    labels = cv2.connectedComponents(opened, connectivity=8)[1].ravel().astype(np.intp)
    hidden = np.bincount(labels, weights=opacity.ravel()) / np.bincount(labels)
    kept = (opened > 0) & (hidden[labels] > MIN_MEAN_OPACITY).reshape(opened.shape)
    # What sways, sways as a whole; where it is plain, nothing is unusual.
    whole = cv2.connectedComponents((opacity > MIN_MEAN_OPACITY).astype(np.uint8), connectivity=8)[1]
    kept |= np.isin(whole, np.setdiff1d(whole[kept], 0))
    return cv2.dilate(kept.astype(np.uint8), _NEIGHBORS, iterations=2) > 0
