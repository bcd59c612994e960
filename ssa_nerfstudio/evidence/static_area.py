"""The area of static edges and of what they enclose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.special import betainc
from torch import Tensor

from ssa_nerfstudio.evidence.edge_evidence import COARSE_FACTOR, EdgeEvidence
from ssa_nerfstudio.evidence.guided_upsampling import reduced_deviation
from ssa_nerfstudio.evidence.null_distribution import SIGNIFICANCE
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL, ImageStatistics

MAX_OPAQUE_DEVIATION = 0.2
"""Deviation relative to the capture's (its 75th percentile) below which an opaque artifact may cover a pixel, and of an
area relative to what surrounds it. On three captures dashboards and buttons have 0.01 to 0.07 of their surroundings,
paths and skies between drops at least 0.45."""
MIN_AREA = COARSE_FACTOR**2
"""Working pixels; smaller areas than a pixel of the coarse scale are ignored."""
_NEIGHBORS = np.ones((3, 3), np.uint8)
_MARGIN = 4
_OUTLINE_WIDTH = 5
"""Working pixels across an outline: an edge of one, widened by two on each side."""


@dataclass(frozen=True)
class ArtifactArea:
    """Where static edges are, and what they enclose."""

    mask: Tensor
    """[H, W] bool: edges, widened by a working pixel, and the areas of low deviation that they enclose."""
    opaque: Tensor
    """[H, W] bool: the areas that hide the scene, because the deviation rises abruptly at their outline."""
    opaque_share: float
    """Share of the frame that may be opaque: edges of low deviation and what they enclose."""


def artifact_area(edges: EdgeEvidence, statistics: ImageStatistics) -> ArtifactArea:
    """Find the area of static edges and the areas that they enclose.

    Args:
        edges: of the views.
        statistics: likewise.
    """
    reduction = statistics.brightness.reduction
    deviation = reduced_deviation(statistics.deviation().float(), reduction)[..., 0].cpu().numpy()
    low = low_deviation(deviation).astype(np.uint8)
    outlines = cv2.dilate(edges.outlines, _NEIGHBORS, iterations=_OUTLINE_WIDTH // 2)
    varying = (low == 0) & ~np.isnan(deviation)
    usual = float(outlines[varying].mean()) if varying.any() else 0.0
    enclosed = _areas_where(low, lambda box, area: _has_outline(outlines[box], area, usual))
    hiding = enclosed | (edges.mask & low)
    level = deviation + GRAY_LEVEL
    closed = cv2.morphologyEx(hiding, cv2.MORPH_CLOSE, _NEIGHBORS)
    opaque = _areas_where(
        closed, lambda box, area: _has_outline(outlines[box], area, usual) and _ends_abruptly(level[box], area)
    )
    layers = np.stack([cv2.dilate(edges.mask, _NEIGHBORS) | enclosed, opaque], axis=-1).astype(np.uint8)
    enlarged = cv2.resize(layers, None, fx=reduction, fy=reduction, interpolation=cv2.INTER_NEAREST)
    height, width = statistics.size
    missing = ((0, height - enlarged.shape[0]), (0, width - enlarged.shape[1]), (0, 0))
    mask, hidden = torch.from_numpy(np.pad(enlarged, missing, mode="edge") > 0).unbind(dim=-1)
    return ArtifactArea(mask, hidden, float(hiding.mean()))


def low_deviation(deviation: np.ndarray) -> np.ndarray:
    """Where views vary so little that an opaque artifact may cover the pixel: bool, given the deviation [h, w].

    Where it is NaN nothing is known, and that is no part of what the capture's views show.
    """
    known = deviation[~np.isnan(deviation)]
    usual = np.quantile(known, 0.75) if known.size else 0.0
    return deviation < max(MAX_OPAQUE_DEVIATION * usual, GRAY_LEVEL / 2)


def connected_parts(area: Tensor, connectivity: int = 8) -> Tensor:
    """Number the connected parts of an area, bool [h, w], from 1: int64 [h, w], 0 elsewhere."""
    labels = cv2.connectedComponents(area.to("cpu", torch.uint8).numpy(), connectivity=connectivity)[1]
    return torch.from_numpy(labels).to(area.device, torch.int64)


def parts_of_share(area: Tensor, share: float) -> Tensor:
    """Number those connected parts of an area, bool [h, w], that cover a share of the frame: int64 [h, w], else 0."""
    parts = connected_parts(area)
    return torch.where(parts.flatten().bincount()[parts] < share * parts.numel(), 0, parts)


def _has_outline(outlines: np.ndarray, area: np.ndarray, usual: float) -> bool:
    """Whether at least half of an area's outline is edges: a uniform artifact has them, a uniform sky does not.

    Behind rain a sky has them, too, but no more than anywhere else. So there must be more on the outline than by
    chance, or at least twice as many places without one inside, also not by chance, because a panel hides rain. By
    chance a place is an edge with the probability `usual`, the share of edges where views vary; places are as far apart
    as an outline is wide.
    """
    around = cv2.dilate(area, _NEIGHBORS) > area
    if not around.any():
        return True
    edges = outlines[around] > 0
    if edges.mean() < 0.5:
        return False
    if _tail(edges.sum() / _OUTLINE_WIDTH, len(edges) / _OUTLINE_WIDTH, usual) < SIGNIFICANCE:
        return True
    plain = outlines[cv2.erode(area, _NEIGHBORS, iterations=_OUTLINE_WIDTH) > 0] == 0
    without, places = plain.sum() / _OUTLINE_WIDTH**2, len(plain) / _OUTLINE_WIDTH**2
    often = without >= 2 * (1 - usual) * places
    return bool(often and _tail(without, places, 1 - usual) < SIGNIFICANCE)


def _tail(found: float, places: float, probability: float) -> float:
    """Probability of at least so many successes, by the binomial distribution, continued to parts of a place."""
    return float(betainc(found, places - found + 1, probability)) if found > 0 else 1.0


def _ends_abruptly(level: np.ndarray, area: np.ndarray) -> bool:
    """Whether the deviation rises abruptly at an area's outline.

    A path between drops of mud is an area of low deviation among static edges, too, but at its end, a drop, the
    deviation does not rise.
    """
    known = ~np.isnan(level)
    outside = known & (cv2.dilate(area, _NEIGHBORS, iterations=3) > cv2.dilate(area, _NEIGHBORS))
    within = known & (area > cv2.erode(area, _NEIGHBORS, iterations=2))
    unbounded = not outside.any() or not within.any()
    return bool(unbounded or np.median(level[within]) <= MAX_OPAQUE_DEVIATION * np.median(level[outside]))


def _areas_where(areas: np.ndarray, kept: Callable[[tuple[slice, slice], np.ndarray], bool]) -> np.ndarray:
    """The connected areas of at least MIN_AREA, uint8 [h, w], for which a function of the box around one is true."""
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(areas, connectivity=4)
    found = np.zeros_like(areas)
    for label in range(1, count):
        x, y, w, h, size = boxes[label]
        box = slice(max(0, y - _MARGIN), y + h + _MARGIN), slice(max(0, x - _MARGIN), x + w + _MARGIN)
        area = (labels[box] == label).astype(np.uint8)
        if size >= MIN_AREA and kept(box, area):
            found[box] |= area
    return found
