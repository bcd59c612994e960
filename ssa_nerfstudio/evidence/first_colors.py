"""Colors of the scene's points before anything is known of what is in front of them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.expected_layers import DETAIL_RADIUS
from ssa_nerfstudio.evidence.guided_upsampling import local_mean
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed

COLOR_ROUNDS = 3
"""Alternations between the points' colors and the pixels that hide them."""
MOST_SHOWN = 1 / 3
"""Share of the scene up to which a pixel counts as hiding it in these."""

_LEAST_WEIGHT = 1e-3
"""Of a sample that is left out of a median: a point that has no others keeps a color."""


def first_colors(
    samples: PointSamples, mean: Tensor, deviation: Tensor, always_hiding: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Estimate the points' colors by medians, and what they leave of the samples.

    A color is the median of the point's samples, each weighed by how much the photos vary at its pixel: what is in
    front varies little. But a thumb in changing light may vary more than a plain floor. So colors and the pixels that
    hide them are found by turns, and the samples of these leave the median to the others. A pixel has to hide two
    thirds of the scene for that, and half of it to start as opaque, because the colors, too, are uncertain where all
    photos agree.

    Behind what is opaque every sample is an outlier to a clear pixel. Robust weights would then silence all of them,
    and the prior would take the pixel for clear. So the residuals of a pixel that hides are those of an opaque one.

    Args:
        samples: of the scene's points.
        mean: of the photos, [h, w, 3] in [0, 1] at the working resolution.
        deviation: of the photos, [h, w, 1], likewise; NaN where it is unknown.
        always_hiding: bool [h, w, 1]: pixels that are known to hide the scene in all photos; None: no such are known.

    Returns:
        Colors of the points [N, 3] in [0, 1], and residuals of the samples [S, 3].
    """
    variance = deviation.flatten().square()
    relative = (variance / variance.nanmedian().clamp_min(1e-12)).nan_to_num(1.0).clamp_max(1.0)
    weight = relative[samples.pixel].double() + _LEAST_WEIGHT
    constant = samples.color - mean.reshape(-1, 3)[samples.pixel]
    colors = _medians(samples, weight)
    always = False if always_hiding is None else always_hiding.flatten()[samples.pixel]
    for _ in range(COLOR_ROUNDS):
        hiding = always | _hiding(samples, samples.color - colors[samples.point], constant, MOST_SHOWN)
        colors = _medians(samples, torch.where(hiding, _LEAST_WEIGHT * weight, weight))
    clear = samples.color - colors[samples.point]
    hiding = always | _hiding(samples, clear, constant, 0.5)
    return colors, torch.where(hiding[:, None], constant, clear)


def _hiding(samples: PointSamples, clear: Tensor, constant: Tensor, shown: float) -> Tensor:
    """Whether less than the share `shown` of the scene comes through where a sample is, bool [S].

    What comes through of a scene varies by T |C - mean C|, so differences from the photos' mean, `constant` [S, 3], are
    T / (1 - T) times those from the points, `clear`, summed over their absolute values around the pixel.
    """
    height, width = samples.size
    excess = (constant.abs() - shown / (1 - shown) * clear.abs()).sum(dim=-1, keepdim=True)
    around = local_mean(summed(samples.pixel, excess, height * width).reshape(height, width, 1), DETAIL_RADIUS)
    return around.flatten()[samples.pixel] < 0


def _medians(samples: PointSamples, weight: Tensor) -> Tensor:
    """Weighted median colors [N, 3] of the points, given the samples' weights [S]."""
    sums = nn.functional.pad(weight.cumsum(0), (1, 0))
    points = torch.arange(samples.points, device=weight.device)
    first = torch.searchsorted(samples.point, points)
    last = torch.searchsorted(samples.point, points, right=True)
    middle = torch.searchsorted(sums, (sums[first] + sums[last]) / 2) - 1
    return samples.color[middle.clamp(0, len(samples.color) - 1)]
