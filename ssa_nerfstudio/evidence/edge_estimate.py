"""What an artifact looks like, from its edges alone: a matte and a difference in color before anything is trained.

A photo shows I = T C + B, so that the deviation of the views is T times that of the scene behind, and their mean
differs from the scene's by B - (1 - T) C. At static edges the gradients of both belong to the artifact, elsewhere to
the scene. Integrating them where edges are static, and nothing elsewhere, gives log T and that difference
(gradient-domain reconstruction, as in Perez et al. 2003). A sky or a path that stays in place has no static edges
around it, and gets 0.
docs/method.md derives it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from ssa_nerfstudio.evidence.poisson import divergence, integrated

BACKGROUND_SCALE = 2.0
"""Working pixels (sigma): gradients that vary this slowly along static edges are the scene's, and are subtracted."""
LEAST_MATTE = 0.1
"""An estimated matte from which on an artifact is at work; that of the constant initialization."""
LEAST_DIFFERENCE = 10 / 255
"""Difference in color from which on an artifact is at work."""
REACH = 32
"""Working pixels from the nearest static edge beyond which the estimate is nothing: where edges have gaps, it leaks."""
OPAQUE_STEP = 1.6
"""Natural logarithm of the ratio of the deviations outside and inside, from which on an area is opaque: a fifth. On
three captures opaque dashboards and buttons have 2.6 to 4.5, paths and skies between drops at most 0.8."""
TEXTURED_SHARE = 0.2
"""Share of static edges in a window, from which on what is there has a texture of its own ..."""
TEXTURE_WINDOW = 9
"""... side of the window, working pixels ..."""
TEXTURED_DEVIATION = 0.5
"""... if the deviation is below this share of the frame's (its 75th percentile)."""
SMALLEST_AREA = 16
"""Working pixels; a smaller area says nothing of its surroundings."""
_LEVEL = 1 / 255


@dataclass(frozen=True)
class Estimate:
    """At the working resolution."""

    matte: np.ndarray
    """[h, w] in [0, 1]: 1 - T; 0 where there is no more than what comes of noise."""
    difference: np.ndarray
    """[3, h, w] in [-1, 1]: mean of the views minus the mean without the artifact, likewise."""


def estimate(mean: np.ndarray, deviation: np.ndarray, edges: np.ndarray, hidden: np.ndarray) -> Estimate:
    """What the artifact behind static edges looks like, where it is not opaque.

    Args:
        mean: of the views, [3, h, w] in [0, 1].
        deviation: of the views, [h, w].
        edges: static edges, uint8 [h, w].
        hidden: what is `opaque`, uint8 [h, w]. Its edges are left out: log T is beyond measure behind them, and through
            a gap in such an outline it would leak.
    """
    edges = edges * (cv2.dilate(hidden, _square(7)) == 0)
    within = cv2.distanceTransform(1 - edges, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= REACH
    edges = cv2.dilate(edges, _square(3)) > 0
    matte = 1 - np.exp(np.minimum(_static_part(np.log(deviation + _LEVEL), edges), 0))
    difference = np.stack([_static_part(channel, edges) for channel in mean])
    there = (matte > LEAST_MATTE) | (np.abs(difference).max(axis=0) > LEAST_DIFFERENCE)
    there = cv2.dilate((there & within).astype(np.uint8), _square(3))
    return Estimate(matte * there, difference * there)


def opaque(areas: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Those connected areas behind which nothing shows: the deviation rises at once where they end. uint8 [h, w].

    A path between drops of mud is an area of low deviation among static edges, too; but where it ends, at a drop, the
    deviation does not rise.

    Args:
        areas: of low deviation, uint8 [h, w].
        deviation: of the views, [h, w].
    """
    areas = cv2.morphologyEx(areas, cv2.MORPH_CLOSE, _square(3))
    level = np.log(deviation + _LEVEL)
    kept = np.zeros_like(areas)
    for box, area in connected(areas, margin=4):
        outside = cv2.dilate(area, _square(7)) > cv2.dilate(area, _square(3))
        within = area > cv2.erode(area, _square(5))
        everything = not outside.any() or not within.any()
        if everything or np.median(level[box][outside]) - np.median(level[box][within]) >= OPAQUE_STEP:
            kept[box] |= area
    return kept


def textured(edges: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Where an artifact has a texture of its own and hides much: dense static edges, low deviation. uint8 [h, w].

    A bonnet that mirrors the passing scene; its deviation does not rise fivefold where it ends. A path behind drops of
    mud looks the same, but for what it is behind; bonnets are more frequent.

    Args:
        edges: static edges, uint8 [h, w].
        deviation: of the views, [h, w].
    """
    dense = cv2.blur(edges.astype(np.float32), (TEXTURE_WINDOW, TEXTURE_WINDOW)) >= TEXTURED_SHARE
    calm = deviation < TEXTURED_DEVIATION * np.quantile(deviation, 0.75)
    return cv2.morphologyEx((dense & calm).astype(np.uint8), cv2.MORPH_CLOSE, _square(3))


def connected(areas: np.ndarray, margin: int) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Each connected area of at least SMALLEST_AREA: a box around it with a margin, and the area in it, uint8."""
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(areas, connectivity=4)
    for label in range(1, count):
        x, y, w, h, size = boxes[label]
        if size >= SMALLEST_AREA:
            box = slice(max(0, y - margin), y + h + margin), slice(max(0, x - margin), x + w + margin)
            yield box, (labels[box] == label).astype(np.uint8)


def _static_part(image: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The image [h, w] whose gradients are nearest to this one's at edges, and to 0 elsewhere; its median is 0."""
    across, down = _above_background(np.diff(image, axis=1)), _above_background(np.diff(image, axis=0))
    across *= edges[:, 1:] & edges[:, :-1]
    down *= edges[1:] & edges[:-1]
    part = integrated(divergence(across, down))
    return part - np.median(part)


def _above_background(gradient: np.ndarray) -> np.ndarray:
    return gradient - cv2.GaussianBlur(gradient, (0, 0), BACKGROUND_SCALE) if gradient.size else gradient


def _square(side: int) -> np.ndarray:
    return np.ones((side, side), np.uint8)
