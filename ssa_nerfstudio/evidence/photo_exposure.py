"""Exposure of the photos, from the scene's points: a point has one color, and whatever all points of a photo share is
the photo's exposure."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ssa_nerfstudio.evidence.layer_estimate import OUTLIER_SCALE, robust_deviation
from ssa_nerfstudio.evidence.point_samples import PointSamples, View, regular_subset, sample_points

USABLE = (0.04, 0.96)
"""Values whose logarithm says something about exposure: above the noise of dark pixels, below clipping."""
ROUNDS = 10
"""Of reweighting."""
MIN_WEIGHT = 1e-3
"""Of a sample at a pixel that shows the same in all photos."""
DAMPING = 1.0
"""Weight of a gain of 1, in samples: a photo without usable ones is taken for one of mean exposure."""
CLEAR = 0.05
"""Opacity up to which a pixel shows the scene."""
PRESENT = 0.1
"""Added light from which on a pixel says whether the artifact follows the exposure."""


def sample_each(points: Tensor, views: Sequence[View]) -> list[PointSamples]:
    """Sample the same points in each view by itself: `sample_points`, and which view shows what stays known.

    Args:
        points: [N, 3], world units.
        views: of any sizes.
    """
    points = regular_subset(points, len(views))
    return [sample_points(points, [view]) for view in views]


@torch.no_grad()
def relative_gains(samples: Sequence[PointSamples], layers: Sequence[Tensor | None] | None = None) -> Tensor:
    """Estimate each photo's gain by robust regression: log I = log C + log g + noise, with C of each point unknown.

    A sample counts by the variance of the photos at its pixel, because what is in front of the scene varies little.

    Args:
        samples: of the same points, for each photo; at least one photo.
        layers: T and B [h, w, 4] in each photo's working frame, None where it has no overlay: samples behind the
            artifact are left out. Without any, all count.

    Returns:
        Logarithms of the gains [V, 3]; their mean over the photos is 0.
    """
    colors = _by_view(samples, [each.color for each in samples])
    usable = (colors > USABLE[0]) & (colors < USABLE[1])
    if layers is not None:
        usable &= (_opacity(_by_view(samples, _layers_at(samples, layers))) < CLEAR)[..., None]
    weight = _by_view(samples, _variability(samples)) * usable
    return torch.stack([_regression(colors[..., c].log(), weight[..., c].nan_to_num()) for c in range(3)], dim=1)


@torch.no_grad()
def artifact_follows(
    samples: Sequence[PointSamples], layers: Sequence[Tensor | None], log_gains: Tensor
) -> bool | None:
    """Whether the artifact's brightness follows the photos' exposure: it is on the lens, and not drawn by software.

    With T, B and the points' colors C known, a sample behind the artifact is g (T C + B) or T g C + B. The smaller sum
    of absolute differences decides (Laplacian noise).

    Args:
        samples, layers: as for `relative_gains`.
        log_gains: [V, 3].

    Returns:
        None where no sample says anything.
    """
    colors = _by_view(samples, [each.color for each in samples])
    here = _by_view(samples, _layers_at(samples, layers))
    transmittance, addition, gain = here[..., :1], here[..., 1:], log_gains.exp()[:, None]
    shown = (_opacity(here) < CLEAR)[..., None]
    scene = torch.where(shown, colors / gain, torch.nan).nanmedian(dim=0).values
    rest = colors - transmittance * gain * scene - addition
    follows = (gain - 1) * addition
    told = (addition > PRESENT) & rest.isfinite()
    return bool((rest - follows)[told].abs().sum() < rest[told].abs().sum()) if told.any() else None


def _regression(values: Tensor, certainty: Tensor) -> Tensor:
    """Effects of the views [V] on values [V, P] = view + point + noise, weighed by certainty [V, P]; their mean is 0.

    The points are eliminated, and the views solved for with Cauchy's weights.
    """
    usable = certainty > 0
    values = torch.where(usable, values, 0.0).double()
    weight = certainty = certainty.double()
    damping = DAMPING * torch.eye(len(values)).to(values)
    for _ in range(ROUNDS):
        share = weight / weight.sum(dim=0).clamp_min(1e-9)
        centered = weight * (values - (share * values).sum(dim=0))
        views = torch.linalg.solve(weight.sum(dim=1).diag() - weight @ share.T + damping, centered.sum(dim=1))
        rest = values - views[:, None]
        rest = rest - (share * rest).sum(dim=0)
        if usable.any():
            weight = certainty / (1 + (rest / (OUTLIER_SCALE * robust_deviation(rest[usable]))).square())
    return (views - views.mean()).float()


def _variability(samples: Sequence[PointSamples]) -> list[Tensor]:
    """Variance of the brightness at each sample's pixel over the photos of its size, at most the median: [S, 1]."""
    weights = [each.color[:, :1] for each in samples]
    for size in {each.size for each in samples}:
        alike = [view for view, each in enumerate(samples) if each.size == size]
        pixel = torch.cat([samples[view].pixel for view in alike])
        brightness = torch.cat([samples[view].color.mean(dim=-1) for view in alike])
        count = torch.bincount(pixel, minlength=size[0] * size[1]).clamp_min(1)
        mean = torch.bincount(pixel, brightness, minlength=len(count)) / count
        squares = torch.bincount(pixel, (brightness - mean[pixel]).square(), minlength=len(count))
        variance = squares / (count - 1).clamp_min(1)
        several = variance[count > 1]
        usual = several.median().clamp_min(1e-12) if len(several) else variance.new_ones(())
        weight = (variance / usual).clamp(MIN_WEIGHT, 1.0)
        for view in alike:
            weights[view] = weight[samples[view].pixel][:, None]
    return weights


def _by_view(samples: Sequence[PointSamples], values: Sequence[Tensor]) -> Tensor:
    """Values [S, C] of each view's samples as [V, P, C], NaN where a view does not see a point."""
    table = values[0].new_full((len(samples), samples[0].points, values[0].shape[1]), torch.nan)
    for row, each, value in zip(table, samples, values, strict=True):
        row[each.point] = value
    return table


def _layers_at(samples: Sequence[PointSamples], layers: Sequence[Tensor | None]) -> list[Tensor]:
    """T and B [S, 4] at each view's samples."""
    clear = samples[0].color.new_tensor([1.0, 0.0, 0.0, 0.0])
    per_view = zip(samples, layers, strict=True)
    return [clear.expand(len(s.pixel), 4) if x is None else x.reshape(-1, 4)[s.pixel] for s, x in per_view]


def _opacity(layers: Tensor) -> Tensor:
    """Of T and B [..., 4]: what hides or lights more."""
    return torch.maximum(1 - layers[..., 0], layers[..., 1:].amax(dim=-1))
