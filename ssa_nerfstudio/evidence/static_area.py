"""The area that static edges enclose: where an artifact is, where it is opaque, and what it looks like."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.additive_light import adds_light
from ssa_nerfstudio.evidence.edge_estimate import connected, estimate, opaque, textured
from ssa_nerfstudio.evidence.statistics import ImageStatistics

LOW_DEVIATION = 0.2
"""Deviation relative to the capture's (its 75th percentile) below which a pixel can be behind an opaque artifact."""
HALF_A_GREY_LEVEL = 0.5 / 255
"""Deviations below this are low in any capture, and tell of no displacement."""
NEAR = 16
"""Working pixels around a static edge in which its artifact may go on: thin mud, drops whose edges were missed."""
EDGE_SUPPORT = 0.5
"""Share of an area's outline that has to be static edges: a plain artifact has them all around, a plain sky has not."""
_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class StaticArea:
    """Where an artifact would be, whatever the verdict, and what it looks like: what an overlay starts from."""

    inside: Tensor
    """[H, W] bool: static edges, and plain areas among them."""
    near: Tensor
    """[H, W] bool: that, all within NEAR working pixels of a static edge, and what the edges imply."""
    opaque: Tensor
    """[H, W] bool: where nothing or little shows through (`estimate.opaque`, `estimate.textured`)."""
    matte: Tensor
    """[H, W] in [0, 1], as the edges imply it (`estimate.estimate`)."""
    difference: Tensor
    """[H, W, 3] in [-1, 1]: mean of the views minus the mean without the artifact, likewise."""
    adds_light: bool
    """The artifact shines and hides nothing (`formation.adds_light`)."""

    @classmethod
    def plain(cls, constant: Tensor) -> StaticArea:
        """Opaque where `constant` [H, W], and nothing elsewhere; without edges that say more."""
        return cls(constant, constant, constant, torch.zeros(constant.shape), torch.zeros(*constant.shape, 3), False)


@dataclass(frozen=True)
class EnclosedAreas:
    """Areas of low deviation among static edges, at the working resolution."""

    statistics: ImageStatistics
    """Of the views."""
    edges: np.ndarray
    """Static edges, uint8 [h, w]."""
    deviation: np.ndarray
    """Of the views, [h, w]."""
    low: np.ndarray
    """bool [h, w]: the views agree so far that an opaque artifact may be the reason."""
    plain: np.ndarray
    """uint8 [h, w]: where it is low, and static edges are all around."""

    @classmethod
    def by(cls, edges: np.ndarray, statistics: ImageStatistics) -> EnclosedAreas:
        """Those among these edges, uint8 [h, w]."""
        deviation = _at_working_size(statistics.deviation(), statistics)[0]
        low = _low(deviation)
        plain = _supported(low.astype(np.uint8), cv2.dilate(edges, _AROUND, iterations=2))
        return cls(statistics, edges, deviation, low, plain)

    @property
    def opaque_share(self) -> float:
        """Of the frame."""
        return float((self.plain | (self.edges & self.low)).mean())

    def area(self) -> StaticArea:
        """Edges, widened, and the areas among them; and what the edges imply."""
        mean = _at_working_size(self.statistics.mean(), self.statistics)
        hidden = opaque(self.plain | (self.edges & self.low), self.deviation)
        looks = estimate(mean, self.deviation, self.edges, hidden)
        distance = cv2.distanceTransform(1 - self.edges, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        near = (distance <= NEAR) | (looks.matte > 0) | looks.difference.any(axis=0)
        light = adds_light(mean.mean(axis=0), self.deviation, (self.edges > 0) & ~self.low)
        if not light:
            hidden |= textured(self.edges, self.deviation)
        masks = cv2.dilate(self.edges, _AROUND) | self.plain, near.astype(np.uint8), hidden
        inside, near, hidden = (_at_full_size(mask, self.statistics) > 0 for mask in masks)
        return StaticArea(
            inside=inside,
            near=inside | near,
            opaque=hidden,
            matte=_at_full_size(looks.matte, self.statistics),
            difference=torch.stack([_at_full_size(channel, self.statistics) for channel in looks.difference], dim=-1),
            adds_light=light,
        )


def _low(deviation: np.ndarray) -> np.ndarray:
    """Where the views agree so far that an opaque artifact may be the reason, bool [h, w]."""
    return deviation < max(LOW_DEVIATION * np.quantile(deviation, 0.75), HALF_A_GREY_LEVEL)


def _at_working_size(layer: Tensor, statistics: ImageStatistics) -> np.ndarray:
    """A layer [H, W, C] of the frame as [C, h, w]; rows and columns that fill no block are dropped."""
    reduction = statistics.brightness.reduction
    h, w = (side // reduction for side in statistics.size)
    planes = layer[: h * reduction, : w * reduction].permute(2, 0, 1)[None].float()
    return nn.functional.avg_pool2d(planes, reduction)[0].cpu().numpy()


def _at_full_size(layer: np.ndarray, statistics: ImageStatistics) -> Tensor:
    """A layer [h, w] at the working resolution as [H, W]: bytes by repetition, others linearly."""
    height, width = statistics.size
    reduction = statistics.brightness.reduction
    way = cv2.INTER_NEAREST if layer.dtype == np.uint8 else cv2.INTER_LINEAR
    enlarged = cv2.resize(layer, None, fx=reduction, fy=reduction, interpolation=way)
    missing = ((0, height - enlarged.shape[0]), (0, width - enlarged.shape[1]))
    return torch.from_numpy(np.pad(enlarged, missing, mode="edge"))


def _supported(areas: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Those connected areas whose outline is made of edges for a share of EDGE_SUPPORT: uint8 [h, w]."""
    supported = np.zeros_like(areas)
    for box, inside in connected(areas, margin=1):
        outline = cv2.dilate(inside, _AROUND) > inside
        if not outline.any() or edges[box][outline].mean() >= EDGE_SUPPORT:
            supported[box] |= inside
    return supported
