"""The area that static edges enclose: where an artifact is, where it is opaque, and its estimated layers."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.additive_light import adds_light
from ssa_nerfstudio.evidence.edge_estimate import connected_areas, estimate_layers, opaque_areas, textured_areas
from ssa_nerfstudio.evidence.statistics import ImageStatistics

MAX_OPAQUE_DEVIATION = 0.2
"""Deviation relative to the capture's (its 75th percentile) below which an opaque artifact may cover a pixel."""
HALF_GRAY_LEVEL = 0.5 / 255
"""Deviations below this are low in any capture, and do not indicate a displacement."""
NEAR_DISTANCE = 16
"""Working pixels around a static edge in which its artifact may continue: thin mud, drops whose edges were missed."""
MIN_OUTLINE_SHARE = 0.5
"""Share of an area's outline that has to be static edges: a uniform artifact has them, a uniform sky does not."""
_NEIGHBORS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class StaticArea:
    """Where an artifact would be, whatever the verdict, and its estimated layers; an overlay is initialized from it."""

    inside: Tensor
    """[H, W] bool: static edges, and the uniform areas that they enclose."""
    near: Tensor
    """[H, W] bool: `inside`, NEAR_DISTANCE working pixels around static edges, and where the layers are not zero."""
    opaque: Tensor
    """[H, W] bool: where nothing or little shows through (`opaque_areas`, `textured_areas`)."""
    matte: Tensor
    """[H, W] in [0, 1], estimated from the edges (`estimate_layers`)."""
    difference: Tensor
    """[H, W, 3] in [-1, 1]: mean of the views minus the mean without the artifact, estimated likewise."""
    adds_light: bool
    """Whether the artifact adds light and hides nothing (`additive_light.adds_light`)."""

    @classmethod
    def from_mask(cls, mask: Tensor) -> StaticArea:
        """An area that is opaque in the mask [H, W], bool, and nothing elsewhere; without estimated layers."""
        return cls(mask, mask, mask, torch.zeros(mask.shape), torch.zeros(*mask.shape, 3), False)


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
    def from_edges(cls, edges: np.ndarray, statistics: ImageStatistics) -> EnclosedAreas:
        """Find the areas that edges, uint8 [h, w], enclose."""
        deviation = _at_working_size(statistics.deviation(), statistics)[0]
        low = deviation < max(MAX_OPAQUE_DEVIATION * np.quantile(deviation, 0.75), HALF_GRAY_LEVEL)
        enclosed = _with_edge_outline(low.astype(np.uint8), cv2.dilate(edges, _NEIGHBORS, iterations=2))
        return cls(statistics, edges, deviation, low, enclosed)

    @property
    def opaque_share(self) -> float:
        """Share of the frame that may be opaque."""
        return float((self.enclosed | (self.edges & self.low)).mean())

    def to_static_area(self) -> StaticArea:
        """Edges, widened by a pixel, the areas that they enclose, and the layers estimated from them."""
        mean = _at_working_size(self.statistics.mean(), self.statistics)
        hidden = opaque_areas(self.enclosed | (self.edges & self.low), self.deviation)
        estimate = estimate_layers(mean, self.deviation, self.edges, hidden)
        distance = cv2.distanceTransform(1 - self.edges, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        near = (distance <= NEAR_DISTANCE) | (estimate.matte > 0) | estimate.difference.any(axis=0)
        light = adds_light(mean.mean(axis=0), self.deviation, (self.edges > 0) & ~self.low)
        if not light:
            hidden |= textured_areas(self.edges, self.deviation)
        masks = cv2.dilate(self.edges, _NEIGHBORS) | self.enclosed, near.astype(np.uint8), hidden
        inside, near, hidden = (_at_full_size(mask, self.statistics) > 0 for mask in masks)
        return StaticArea(
            inside=inside,
            near=inside | near,
            opaque=hidden,
            matte=_at_full_size(estimate.matte, self.statistics),
            difference=torch.stack([_at_full_size(c, self.statistics) for c in estimate.difference], dim=-1),
            adds_light=light,
        )


def _at_working_size(layer: Tensor, statistics: ImageStatistics) -> np.ndarray:
    """A layer [H, W, C] of the frame as [C, h, w] at the working resolution; partial blocks are dropped."""
    reduction = statistics.brightness.reduction
    h, w = (side // reduction for side in statistics.size)
    planes = layer[: h * reduction, : w * reduction].permute(2, 0, 1)[None].float()
    return nn.functional.avg_pool2d(planes, reduction)[0].cpu().numpy()


def _at_full_size(layer: np.ndarray, statistics: ImageStatistics) -> Tensor:
    """A layer [h, w] at the working resolution as [H, W]: uint8 by repetition, float linearly."""
    height, width = statistics.size
    reduction = statistics.brightness.reduction
    interpolation = cv2.INTER_NEAREST if layer.dtype == np.uint8 else cv2.INTER_LINEAR
    enlarged = cv2.resize(layer, None, fx=reduction, fy=reduction, interpolation=interpolation)
    missing = ((0, height - enlarged.shape[0]), (0, width - enlarged.shape[1]))
    return torch.from_numpy(np.pad(enlarged, missing, mode="edge"))


def _with_edge_outline(areas: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The connected areas of whose outline at least MIN_OUTLINE_SHARE is edges: uint8 [h, w]."""
    kept = np.zeros_like(areas)
    for box, inside in connected_areas(areas, margin=1):
        outline = cv2.dilate(inside, _NEIGHBORS) > inside
        if not outline.any() or edges[box][outline].mean() >= MIN_OUTLINE_SHARE:
            kept[box] |= inside
    return kept
