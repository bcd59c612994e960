"""The area of static edges and of what they enclose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio.evidence.edge_evidence import COARSE_FACTOR
from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL, ImageStatistics

MAX_OPAQUE_DEVIATION = 0.2
"""Deviation relative to the capture's (its 75th percentile) below which an opaque artifact may cover a pixel, and of an
area relative to what surrounds it. On three captures dashboards and buttons have 0.01 to 0.07 of their surroundings,
paths and skies between drops at least 0.45."""
MIN_AREA = COARSE_FACTOR**2
"""Working pixels; smaller areas than a pixel of the coarse scale are ignored."""
_NEIGHBORS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class EnclosedAreas:
    """Areas of low deviation that static edges enclose, at the working resolution."""

    statistics: ImageStatistics
    """Of the views."""
    edges: np.ndarray
    """Static edges, uint8 [h, w]."""
    deviation: np.ndarray
    """Of the views, [h, w]."""
    low: np.ndarray
    """bool [h, w]: where the deviation is low enough for an opaque artifact."""
    enclosed: np.ndarray
    """uint8 [h, w]: areas of low deviation whose outline is static edges."""

    @classmethod
    def from_edges(cls, edges: np.ndarray, outlines: np.ndarray, statistics: ImageStatistics) -> EnclosedAreas:
        """Find the areas that edges enclose.

        Args:
            edges: static edges, uint8 [h, w].
            outlines: edges and what continues them, likewise.
            statistics: of the views.
        """
        deviation = reduced(statistics.deviation().float(), statistics.brightness.reduction)[..., 0].cpu().numpy()
        low = low_deviation(deviation)
        enclosed = _with_edge_outline(low.astype(np.uint8), cv2.dilate(outlines, _NEIGHBORS, iterations=2))
        return cls(statistics, edges, deviation, low, enclosed)

    @property
    def opaque_share(self) -> float:
        """Share of the frame that may be opaque."""
        return float(self._hiding.mean())

    @property
    def _hiding(self) -> np.ndarray:
        """uint8 [h, w]: enclosed areas, and edges of low deviation."""
        return self.enclosed | (self.edges & self.low)

    def mask(self) -> Tensor:
        """[H, W] bool: edges, widened by a pixel, and the areas that they enclose."""
        return self._at_full_size(cv2.dilate(self.edges, _NEIGHBORS) | self.enclosed)

    def opaque(self) -> Tensor:
        """[H, W] bool: the areas that hide the scene, because the deviation rises abruptly at their outline.

        A path between drops of mud is an area of low deviation among static edges, too, but at its end, a drop, the
        deviation does not rise.
        """
        areas = cv2.morphologyEx(self._hiding, cv2.MORPH_CLOSE, _NEIGHBORS)
        level = self.deviation + GRAY_LEVEL
        kept = np.zeros_like(areas)
        for box, area in _connected_areas(areas, margin=4):
            outside = cv2.dilate(area, _NEIGHBORS, iterations=3) > cv2.dilate(area, _NEIGHBORS)
            within = area > cv2.erode(area, _NEIGHBORS, iterations=2)
            unbounded = not outside.any() or not within.any()
            if unbounded or np.median(level[box][within]) <= MAX_OPAQUE_DEVIATION * np.median(level[box][outside]):
                kept[box] |= area
        return self._at_full_size(kept)

    def _at_full_size(self, layer: np.ndarray) -> Tensor:
        height, width = self.statistics.size
        reduction = self.statistics.brightness.reduction
        enlarged = cv2.resize(layer, None, fx=reduction, fy=reduction, interpolation=cv2.INTER_NEAREST)
        missing = ((0, height - enlarged.shape[0]), (0, width - enlarged.shape[1]))
        return torch.from_numpy(np.pad(enlarged, missing, mode="edge") > 0)


def low_deviation(deviation: np.ndarray) -> np.ndarray:
    """Where views vary so little that an opaque artifact may cover the pixel: bool, given the deviation [h, w]."""
    return deviation < max(MAX_OPAQUE_DEVIATION * np.quantile(deviation, 0.75), GRAY_LEVEL / 2)


def calm_areas(deviation: np.ndarray) -> list[np.ndarray]:
    """Connected areas of `low_deviation`, of at least MIN_AREA: flat indices of each one's pixels."""
    count, labels = cv2.connectedComponents(low_deviation(deviation).astype(np.uint8), connectivity=4)
    order = np.argsort(labels, axis=None, kind="stable")
    areas = np.split(order, np.searchsorted(labels.ravel()[order], np.arange(1, count)))[1:]
    return [area for area in areas if len(area) >= MIN_AREA]


def _with_edge_outline(areas: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The connected areas of whose outline at least half is edges: uint8 [h, w].

    A uniform artifact has them, a uniform sky does not.
    """
    kept = np.zeros_like(areas)
    for box, inside in _connected_areas(areas, margin=1):
        outline = cv2.dilate(inside, _NEIGHBORS) > inside
        if not outline.any() or edges[box][outline].mean() >= 0.5:
            kept[box] |= inside
    return kept


def _connected_areas(areas: np.ndarray, margin: int) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Yield the connected areas of at least MIN_AREA: the box around one, with a margin in pixels, and it."""
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(areas, connectivity=4)
    for label in range(1, count):
        x, y, w, h, size = boxes[label]
        if size >= MIN_AREA:
            box = slice(max(0, y - margin), y + h + margin), slice(max(0, x - margin), x + w + margin)
            yield box, (labels[box] == label).astype(np.uint8)
