"""Initialization of an overlay from what the photos say.

Source: the paper, section "Modeling screen-space artifacts" (W = mean, A = exp(-sigma / 0.05)); the estimate from
static edges is ours (docs/method.md).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.static_area import StaticArea
from ssa_nerfstudio.evidence.statistics import ImageStatistics
from ssa_nerfstudio.overlay.layer import CONSTANT_INITIALIZATION, INITIAL_MATTE_RANGE, ScreenSpaceOverlay

STATISTICS_SCALE = 0.05
"""s of the paper: a pixel whose standard deviation over the views is s starts with a matte of 1 / e."""


@torch.no_grad()
def initialize(overlay: ScreenSpaceOverlay, statistics: ImageStatistics, area: StaticArea | None = None) -> None:
    """Initialize color, matte and sparsity weights of an overlay.

    A sky is as constant as a dashboard, but static edges enclose the dashboard alone. With an `area`, only its opaque
    part starts from the statistics. Elsewhere A and W are those that the edges imply, with A at least 0.1 (that of the
    constant start) near the edges and 0.01 far from them. The sparsity term spares what is opaque.

    Args:
        overlay: changed in place.
        statistics: of the photos, of the overlay's frame.
        area: static area of an artifact; None is the paper's rule, sigma alone.

    Raises:
        ValueError: the statistics are of another frame.
    """
    if statistics.size != (overlay.height, overlay.width):
        raise ValueError(f"statistics of a frame {statistics.size} for an overlay of {(overlay.height, overlay.width)}")
    if area is None:
        area = StaticArea.plain(torch.ones(statistics.size, dtype=torch.bool))
    alpha, addition = _layers(statistics, area, overlay.adds_light)
    deviation = statistics.deviation()
    opaque, near = (mask.to(deviation.device)[..., None] for mask in (area.opaque, area.near))
    hidden = area.matte.to(deviation)[..., None]
    if overlay.adds_light:
        hidden = torch.zeros_like(hidden)
    layers = torch.cat([alpha, addition, deviation, opaque, hidden, near], dim=-1)
    alpha, addition, deviation, opaque, hidden, near = _reduced(layers, overlay).split((1, 3, 1, 1, 1, 1), dim=-1)
    color = addition.clamp_min(INITIAL_MATTE_RANGE[0]) if overlay.adds_light else addition / alpha
    overlay.initialize(color, alpha, torch.minimum(_evidence(deviation, opaque), 1 - hidden), near > 0)


def _layers(statistics: ImageStatistics, area: StaticArea, adds_light: bool) -> tuple[Tensor, Tensor]:
    """Matte A [H, W, 1] and addition B [H, W, 3] at the photos' resolution, float64."""
    mean, deviation = statistics.mean(), statistics.deviation()
    opaque, near = (mask.to(mean.device)[..., None] for mask in (area.opaque, area.near))
    matte, difference = area.matte.to(mean)[..., None], area.difference.to(mean)
    floor = torch.where(near, CONSTANT_INITIALIZATION[1], INITIAL_MATTE_RANGE[0])
    if adds_light:
        matte, floor = torch.zeros_like(matte), INITIAL_MATTE_RANGE[0]
    # The matte, not the transmittance, in float64: in float32 one minus exp(-20), where no two views show the pixel,
    # is 1, and its mean color would be lost.
    alpha = torch.where(opaque, torch.exp(-deviation / STATISTICS_SCALE), matte.clamp_min(floor))
    if adds_light:
        return alpha, torch.where(opaque, alpha * mean, difference)
    scene = (mean - torch.where(opaque, 0.0, difference)).clamp(0, 1)
    addition = torch.minimum(alpha * scene + mean - scene, alpha)
    implied = (matte > 0) | (difference != 0).any(dim=-1, keepdim=True)
    shown = torch.where(opaque, 0, matte)
    if shown.any():
        addition = torch.where(opaque | implied, addition, alpha * _mean_color(addition / alpha, shown))
    return alpha, addition


def _reduced(layers: Tensor, overlay: ScreenSpaceOverlay) -> Tensor:
    """Layers [H, W, C] at the overlay's resolution [h, w, C]."""
    if overlay.resolution == 1:
        return layers
    height, width = (side * overlay.resolution for side in overlay.alpha_logits.shape[:2])
    padded = nn.functional.pad(
        layers.permute(2, 0, 1)[None], (0, width - overlay.width, 0, height - overlay.height), mode="replicate"
    )
    return nn.functional.avg_pool2d(padded, overlay.resolution)[0].permute(1, 2, 0)


def _mean_color(color: Tensor, matte: Tensor) -> Tensor:
    """The mean color [3] of an artifact, of colors [H, W, 3] weighed by a matte [H, W, 1].

    Where an artifact was missed, its color is most likely this one, and a film of it is learned no sooner than it is
    there. From the mean of the photos, the matte grows wherever a render is wrong: less contrast is a smaller error.
    """
    return (color.clamp(0, 1) * matte).sum(dim=(0, 1)) / matte.sum()


def _evidence(deviation: Tensor, opaque: Tensor) -> Tensor:
    """r: how much the sparsity weighs on a pixel, 1 where nothing is opaque (its share of the pixel).

    There, r = min(1, sigma / 70th percentile of sigma), near 0 where the views agree, so that sparsity spares what an
    artifact hides. A sky agrees with itself, too; but it is not taken for opaque, and sparsity weighs.
    """
    values = deviation.flatten().float()
    rank = max(1, round(0.7 * values.numel()))
    reference = torch.kthvalue(values, rank).values  # torch.quantile stops at 16 million values
    if reference <= 0:
        return torch.ones_like(deviation)
    return 1 - opaque * (1 - (deviation / reference).clamp_max(1.0))
