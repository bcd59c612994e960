"""The area of an artifact that changes from photo to photo, as a weapon does that sways by a few pixels.

One transmittance and one color are true of none of its photos, so the scene would learn what they leave unexplained.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio.evidence.layer_estimate import MIN_OPACITY, MIN_SHARE, LayerEstimate, robust_deviation
from ssa_nerfstudio.evidence.point_samples import PointSamples
from ssa_nerfstudio.evidence.static_area import parts_of_share
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL

USUAL = 0.99
"""Quantile of the clear pixels: where a larger share of the samples is unexplained than there, it is unusual."""
MIN_MEAN_OPACITY = 0.5
"""An unusual area is an artifact's if it hides half of the scene: shading and reflections on an object that stays in
the middle of the frame hide a quarter, a weapon three quarters."""
MOST_LEFT_BEHIND = 0.5
"""Squares that the layers leave of the samples in a part, as a share of those that they leave of all samples. Behind
what hides more than half, the scene leaves at most a quarter; a half is the geometric mean of that and 1. Parts that
stand still have 0.02 to 0.29, an occlusion 0.72 to 1.28, a weapon that sways 10.7."""
MIN_SAMPLES = 50
"""Of a part: of fewer, more than a hundredth of the parts that stand still (at a quarter) would seem to move."""
_ROUNDING = float(robust_deviation(torch.tensor(GRAY_LEVEL / 2))) ** 2
"""Square of the robust deviation where photos are rounded by half a gray level and nothing else is left."""
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
    return _widened(kept)


def moving_parts(estimate: LayerEstimate, samples: PointSamples) -> np.ndarray:
    """Where parts of an artifact move: bool [h, w], of the working size, two pixels wider than what is found.

    A large part of what hides more than half of the scene moves if the layers leave more of its samples than a scene
    behind it could: of a small one, errors of the layers may be the reason.

    Args:
        estimate: of the layers, with the points' colors.
        samples: that it is of, as photos show them (behind a falloff).
    """
    limit = MOST_LEFT_BEHIND * float(estimate.noise) ** 2
    parts = large_parts(estimate)
    of_sample, kept = parts.flatten()[samples.pixel], torch.zeros_like(parts, dtype=torch.bool)
    for part in parts[parts > 0].unique():
        those = (of_sample == part).nonzero()[:, 0]
        if len(those) < MIN_SAMPLES:
            continue
        # Without the falloff, as the noise is.
        left = estimate.left_of(samples, those) / estimate.falloff.reshape(-1, 1)[samples.pixel[those]]
        if float(robust_deviation(left)) ** 2 > limit + _ROUNDING:
            kept |= parts == part
    return _widened(kept.cpu().numpy())


def large_parts(estimate: LayerEstimate) -> Tensor:
    """Number the connected parts that hide more than half of the scene and cover MIN_SHARE of the frame: int64 [h, w],
    0 elsewhere."""
    return parts_of_share(estimate.opacity()[..., 0] > MIN_MEAN_OPACITY, MIN_SHARE)


def _widened(area: np.ndarray) -> np.ndarray:
    """An area [h, w] and two pixels around it: bool."""
    return cv2.dilate(area.astype(np.uint8), _NEIGHBORS, iterations=2) > 0
