"""Additive light: whether an artifact hides the scene or only adds light to it.

A photo shows I = T C + B. An artifact that hides (T < 1: mud, a watermark, a dashboard) scales the deviation of the
views by T, so the deviation has an edge where the artifact has one. Additive light (T = 1: rain lit by a flash, a
reflection, glare) has edges in the mean of the views alone. Along the artifact's edges only the scene varies: the
deviation's changes in that direction are the scale against which those across the edges are judged.
"""

from __future__ import annotations

import cv2
import numpy as np

MIN_HIDING_RATIO = 2.2
"""Ratio of the deviation's changes across static edges to those along them, from which on an artifact hides the scene.
On three captures rain has 1.1 to 1.6, artifacts that hide 3.2 to 37 (docs/method.md)."""
MIN_EDGES = 50
"""With fewer pixels on static edges the ratio means nothing, and the artifact is taken for one that hides."""
_GRAY_LEVEL = 1 / 255


def adds_light(mean: np.ndarray, deviation: np.ndarray, edges: np.ndarray) -> bool:
    """Test whether static edges belong to additive light.

    Args:
        mean: of the views, [h, w] in [0, 1].
        deviation: of the views, [h, w].
        edges: [h, w] bool, static edges behind which the scene shows through.
    """
    if edges.sum() < MIN_EDGES:
        return False
    x, y = _gradient(mean)
    change_x, change_y = _gradient(np.log(deviation + _GRAY_LEVEL))
    length = np.maximum(np.hypot(x, y), 1e-9)
    across = np.abs(change_x * x + change_y * y) / length
    along = np.abs(change_y * x - change_x * y) / length
    return bool(np.median(across[edges]) < MIN_HIDING_RATIO * np.median(along[edges]))


def _gradient(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient along x and y, per pixel (Scharr)."""
    image = np.ascontiguousarray(image, np.float32)
    return cv2.Scharr(image, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(image, cv2.CV_32F, 0, 1) / 32
