"""Estimation of an artifact's layers from its edges: a matte and a difference in color, before any training.

A photo shows I = T C + B. So the deviation of the views is T times that of the scene behind, and their mean differs
from the scene's by B - (1 - T) C. At static edges the gradients of both belong to the artifact, elsewhere to the scene.
Integrating the gradients of static edges alone gives log T and that difference (gradient-domain reconstruction, as in
Perez et al. 2003). A sky or a path that stays in place is not enclosed by static edges and gets 0.
docs/method.md derives it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from ssa_nerfstudio.evidence.poisson import divergence, solve_poisson

BACKGROUND_SCALE = 2.0
"""Working pixels (sigma): gradients that vary this slowly along static edges are the scene's, and are subtracted."""
MIN_MATTE = 0.1
"""Estimated mattes below this are noise; also the matte of the constant initialization."""
MIN_DIFFERENCE = 10 / 255
"""Estimated differences in color below this are noise."""
MAX_DISTANCE = 32
"""Working pixels from the nearest static edge beyond which the estimate is 0: it leaks through gaps in the edges."""
MIN_OPAQUE_STEP = 1.6
"""Natural logarithm of the ratio of the deviations outside and inside, from which on an area is opaque: a fifth. On
three captures opaque dashboards and buttons have 2.6 to 4.5, paths and skies between drops at most 0.8."""
TEXTURE_WINDOW = 9
"""Side of the window of `textured_areas`, working pixels."""
MIN_TEXTURE_SHARE = 0.2
"""Share of static edges in that window from which on an area is textured ..."""
MAX_TEXTURE_DEVIATION = 0.5
"""... if its deviation, relative to the frame's 75th percentile, is below this."""
MIN_AREA = 16
"""Working pixels; smaller areas are ignored."""
_GRAY_LEVEL = 1 / 255


@dataclass(frozen=True)
class LayerEstimate:
    """Estimated layers at the working resolution."""

    matte: np.ndarray
    """[h, w] in [0, 1]: 1 - T; 0 where the estimate is no more than noise."""
    difference: np.ndarray
    """[3, h, w] in [-1, 1]: mean of the views minus the mean without the artifact, likewise."""


def estimate_layers(mean: np.ndarray, deviation: np.ndarray, edges: np.ndarray, hidden: np.ndarray) -> LayerEstimate:
    """Estimate the layers of the artifact that has these edges, where it is not opaque.

    Args:
        mean: of the views, [3, h, w] in [0, 1].
        deviation: of the views, [h, w].
        edges: static edges, uint8 [h, w].
        hidden: `opaque_areas`, uint8 [h, w]. Their edges are left out: log T is unbounded inside them, and would leak
            through gaps in such an outline.
    """
    edges = edges * (cv2.dilate(hidden, _square(7)) == 0)
    within = cv2.distanceTransform(1 - edges, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= MAX_DISTANCE
    edges = cv2.dilate(edges, _square(3)) > 0
    matte = 1 - np.exp(np.minimum(_static_part(np.log(deviation + _GRAY_LEVEL), edges), 0))
    difference = np.stack([_static_part(channel, edges) for channel in mean])
    present = (matte > MIN_MATTE) | (np.abs(difference).max(axis=0) > MIN_DIFFERENCE)
    present = cv2.dilate((present & within).astype(np.uint8), _square(3))
    return LayerEstimate(matte * present, difference * present)


def opaque_areas(areas: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Select the connected areas that hide the scene: the deviation rises abruptly at their outline.

    A path between drops of mud is an area of low deviation among static edges, too, but at its end, a drop, the
    deviation does not rise.

    Args:
        areas: of low deviation, uint8 [h, w].
        deviation: of the views, [h, w].

    Returns:
        uint8 [h, w].
    """
    areas = cv2.morphologyEx(areas, cv2.MORPH_CLOSE, _square(3))
    level = np.log(deviation + _GRAY_LEVEL)
    kept = np.zeros_like(areas)
    for box, area in connected_areas(areas, margin=4):
        outside = cv2.dilate(area, _square(7)) > cv2.dilate(area, _square(3))
        within = area > cv2.erode(area, _square(5))
        unbounded = not outside.any() or not within.any()
        if unbounded or np.median(level[box][outside]) - np.median(level[box][within]) >= MIN_OPAQUE_STEP:
            kept[box] |= area
    return kept


def textured_areas(edges: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Find where an artifact has a texture of its own and hides much: dense static edges and low deviation.

    Such as a car's hood that mirrors the passing scene, whose deviation does not rise fivefold at its outline. A path
    behind drops of mud has the same statistics; hoods are more frequent.

    Args:
        edges: static edges, uint8 [h, w].
        deviation: of the views, [h, w].

    Returns:
        uint8 [h, w].
    """
    dense = cv2.blur(edges.astype(np.float32), (TEXTURE_WINDOW, TEXTURE_WINDOW)) >= MIN_TEXTURE_SHARE
    calm = deviation < MAX_TEXTURE_DEVIATION * np.quantile(deviation, 0.75)
    return cv2.morphologyEx((dense & calm).astype(np.uint8), cv2.MORPH_CLOSE, _square(3))


def connected_areas(areas: np.ndarray, margin: int) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Iterate over the connected areas of at least MIN_AREA.

    Args:
        areas: uint8 [h, w].
        margin: of the box around an area, pixels.

    Yields:
        The box as two slices, and the area within it, uint8.
    """
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(areas, connectivity=4)
    for label in range(1, count):
        x, y, w, h, size = boxes[label]
        if size >= MIN_AREA:
            box = slice(max(0, y - margin), y + h + margin), slice(max(0, x - margin), x + w + margin)
            yield box, (labels[box] == label).astype(np.uint8)


def _static_part(image: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The image [h, w] whose gradients are nearest to this one's at edges, and to 0 elsewhere; its median is 0."""
    across, down = _above_background(np.diff(image, axis=1)), _above_background(np.diff(image, axis=0))
    across *= edges[:, 1:] & edges[:, :-1]
    down *= edges[1:] & edges[:-1]
    part = solve_poisson(divergence(across, down))
    return part - np.median(part)


def _above_background(gradient: np.ndarray) -> np.ndarray:
    return gradient - cv2.GaussianBlur(gradient, (0, 0), BACKGROUND_SCALE) if gradient.size else gradient


def _square(side: int) -> np.ndarray:
    return np.ones((side, side), np.uint8)
