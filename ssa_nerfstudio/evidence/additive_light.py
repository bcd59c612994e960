"""Does an artifact hide the scene, or does it only add light to it?

A photo shows I = T C + B. What hides (T < 1: mud, a watermark, a dashboard) lowers the deviation of the views behind it
by the factor T, and so the deviation has an edge where the artifact has one. What shines (T = 1: rain in front of a
flash, a reflection, glare) has edges in the mean of the views alone. Along the artifact's edges, where nothing changes
but the scene, the deviation changes by chance: that is the measure of what "no edge" means in this capture.
"""

from __future__ import annotations

import cv2
import numpy as np

STEEPER = 2.2
"""From this ratio on, of the deviation's changes across static edges to those along them, an artifact hides the scene.
On three captures rain has 1.1 to 1.6, and what hides 3.2 to 37 (docs/method.md)."""
LEAST_EDGES = 50
"""With fewer pixels on static edges nothing can be told, and the artifact is taken as one that hides."""
_LEVEL = 1 / 255


def adds_light(mean: np.ndarray, deviation: np.ndarray, edges: np.ndarray) -> bool:
    """Whether static edges are edges of light.

    Args:
        mean: of the views, [h, w] in [0, 1].
        deviation: of the views, [h, w].
        edges: [h, w] bool, static edges behind which the scene shows through.
    """
    if edges.sum() < LEAST_EDGES:
        return False
    x, y = _gradient(mean)
    change_x, change_y = _gradient(np.log(deviation + _LEVEL))
    length = np.maximum(np.hypot(x, y), 1e-9)
    across = np.abs(change_x * x + change_y * y) / length
    along = np.abs(change_y * x - change_x * y) / length
    return bool(np.median(across[edges]) < STEEPER * np.median(along[edges]))


def _gradient(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Along x and y, a pixel (Scharr)."""
    image = np.ascontiguousarray(image, np.float32)
    return cv2.Scharr(image, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(image, cv2.CV_32F, 0, 1) / 32
