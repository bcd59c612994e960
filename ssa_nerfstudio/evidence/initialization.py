"""Initialization of an overlay from statistics of the photos.

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
"""s of the paper: a standard deviation of s over the views gives an initial matte of 1 / e."""


@torch.no_grad()
def initialize(overlay: ScreenSpaceOverlay, statistics: ImageStatistics, area: StaticArea | None = None) -> None:
    """Initialize color, matte and sparsity weights of an overlay.

    A sky is as constant as a dashboard, but static edges enclose the dashboard alone. With an `area`, only its opaque
    part is initialized from the statistics. Elsewhere A and W are those estimated from the edges, with A at least 0.1
    (that of the constant initialization) near the edges and 0.01 far from them. The sparsity loss spares opaque pixels.

    Args:
        overlay: changed in place.
        statistics: of the photos, in the overlay's frame.
        area: static area of an artifact; None for the paper's rule, sigma alone.

    Raises:
        ValueError: the statistics have another frame size than the overlay.
    """
    if statistics.size != (overlay.height, overlay.width):
        raise ValueError(f"statistics of a frame {statistics.size} for an overlay of {(overlay.height, overlay.width)}")
    if area is None:
        area = StaticArea.from_mask(torch.ones(statistics.size, dtype=torch.bool))
    alpha, addition = _layers(statistics, area, overlay.adds_light)
    deviation = statistics.deviation()
    opaque, near = (mask.to(deviation.device)[..., None] for mask in (area.opaque, area.near))
    hidden = area.matte.to(deviation)[..., None]
    if overlay.adds_light:
        hidden = torch.zeros_like(hidden)
    layers = torch.cat([alpha, addition, deviation, opaque, hidden, near], dim=-1)
    alpha, addition, deviation, opaque, hidden, near = _reduced(layers, overlay).split((1, 3, 1, 1, 1, 1), dim=-1)
    color = addition.clamp_min(INITIAL_MATTE_RANGE[0]) if overlay.adds_light else addition / alpha
    overlay.initialize(color, alpha, torch.minimum(_sparsity_weight(deviation, opaque), 1 - hidden), near > 0)


def _layers(statistics: ImageStatistics, area: StaticArea, adds_light: bool) -> tuple[Tensor, Tensor]:
    """Initial A [H, W, 1] and B [H, W, 3] at the photos' resolution, float64."""
    mean, deviation = statistics.mean(), statistics.deviation()
    opaque, near = (mask.to(mean.device)[..., None] for mask in (area.opaque, area.near))
    matte, difference = area.matte.to(mean)[..., None], area.difference.to(mean)
    floor = torch.where(near, CONSTANT_INITIALIZATION[1], INITIAL_MATTE_RANGE[0])
    if adds_light:
        matte, floor = torch.zeros_like(matte), INITIAL_MATTE_RANGE[0]
    # float64, and the matte instead of the transmittance: where no two views show the pixel, 1 - exp(-20) is 1 in
    # float32, and the mean color would be lost.
    alpha = torch.where(opaque, torch.exp(-deviation / STATISTICS_SCALE), matte.clamp_min(floor))
    if adds_light:
        return alpha, torch.where(opaque, alpha * mean, difference)
    scene = (mean - torch.where(opaque, 0.0, difference)).clamp(0, 1)
    addition = torch.minimum(alpha * scene + mean - scene, alpha)
    estimated = (matte > 0) | (difference != 0).any(dim=-1, keepdim=True)
    translucent = torch.where(opaque, 0, matte)
    if translucent.any():
        addition = torch.where(opaque | estimated, addition, alpha * _mean_color(addition / alpha, translucent))
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
    """The mean [3] of colors [H, W, 3] weighted by a matte [H, W, 1].

    It is the likeliest color where the artifact was missed, and a matte of this color grows only where the artifact is.
    A matte with the mean color of the photos would grow wherever a render is wrong: less contrast is a smaller error.
    """
    return (color.clamp(0, 1) * matte).sum(dim=(0, 1)) / matte.sum()


def _sparsity_weight(deviation: Tensor, opaque: Tensor) -> Tensor:
    """Weight r of the sparsity loss [h, w, 1]: 1 where nothing is opaque.

    Where the pixel is opaque (`opaque` is its share), r = min(1, sigma / 70th percentile of sigma): near 0 where the
    views agree, so that sparsity spares the artifact. The views agree on a sky, too, but it is not opaque, so r is 1.

    Args:
        deviation: sigma [h, w, 1].
        opaque: [h, w, 1] in [0, 1].
    """
    values = deviation.flatten().float()
    rank = max(1, round(0.7 * values.numel()))
    reference = torch.kthvalue(values, rank).values  # torch.quantile stops at 16 million values
    if reference <= 0:
        return torch.ones_like(deviation)
    return 1 - opaque * (1 - (deviation / reference).clamp_max(1.0))
