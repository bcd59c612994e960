"""A second estimate of an artifact on which the light changes: in its mean light, or of what follows it, too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ssa_nerfstudio.evidence.artifact_light import HIDING, MAX_COEFFICIENT, affine_terms, changing_light
from ssa_nerfstudio.evidence.detection import Detection
from ssa_nerfstudio.evidence.following_light import follows_light
from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.initialization import estimate, initialize_from
from ssa_nerfstudio.evidence.layer_estimate import OUTLIER_SCALE, LayerEstimate, robust_deviation
from ssa_nerfstudio.evidence.point_samples import PointSamples, View, summed, working_reduction
from ssa_nerfstudio.evidence.statistics import UNKNOWN_DEVIATION
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.shading import COEFFICIENTS, basis_of

ROUNDS = 6
"""Of robust least squares, each with the variance that the coefficients of the round before have."""
MOST_LEFT = 0.5
"""Of the first estimate's squares where the artifact hides, the share below which a light explains how photos differ
there: fingers to which it makes a difference leave 0.07 to 0.31, occlusions, a bonnet, a UI and a finger in constant
light 0.89 to 1.14."""


class Refined(NamedTuple):
    """The last estimate, and what it has told."""

    layers: LayerEstimate
    may_move: bool
    """Whether photos differ where the artifact hides by more than a light explains; `changing_area.moving_parts` tells
    where."""


@dataclass(frozen=True)
class SecondEstimate:
    """Layers from samples in the artifact's mean light, if that explains how they differ; else from those as they are,
    of which more is known to hide the scene (`following_light.follows_light`)."""

    layers: LayerEstimate
    guide: Tensor
    """Of the photos that were sampled, in the mean light or as they are (`initialization.guide_of`)."""
    left: float
    """Squares that layers in the mean light leave where the artifact hides, as a share of those that the first estimate
    leaves."""


def refine_in_mean_light(
    overlay: ScreenSpaceOverlay, found: LayerEstimate, second: SecondEstimate | None, static: Tensor
) -> Refined:
    """Initialize the overlay from a second estimate, if there is one.

    Args:
        overlay: initialized from `found`; changed in place where there is a second estimate.
        found: the first estimate.
        second: the second (`second_estimate`).
        static: [H, W] bool: where static edges are (`Detection.mask`).
    """
    if second is None:
        return Refined(found, may_move=False)
    initialize_from(overlay, second.layers, second.guide, static)
    return Refined(second.layers, may_move=second.left >= MOST_LEFT)


@torch.no_grad()
def second_estimate(
    overlay: ScreenSpaceOverlay,
    found: LayerEstimate,
    samples: PointSamples,
    guide: Tensor,
    views: Sequence[View],
    detection: Detection,
) -> SecondEstimate | None:
    """Estimate the layers once more; None where the light on them does not change, or no sample is hidden.

    To an estimate, changes of the light are noise, and some of it passes for scene. The colors of the points tell them
    apart: what the first estimate leaves of the samples is fitted by a light for each view, and the second is of the
    samples without it. It holds where it leaves less than half of the first one's squares. Where an artifact moves, a
    light explains little of them; but it shows what else belongs to the artifact, which another estimate then knows.

    Args:
        overlay: initialized from `found`.
        found: the first estimate.
        samples: that it is of.
        guide: of the photos (`initialization.guide_of`).
        views: the photos, that all show the artifact.
        detection: from the same photos.
    """
    device = samples.color.device
    basis, (transmittance, addition) = basis_of(overlay).to(device), (layer.to(device) for layer in overlay.layers())
    guide, reduction = guide.to(device), working_reduction(overlay.height, overlay.width)
    images, masks = [view.image for view in views], [view.mask for view in views]
    if found.colors is None or changing_light(images, masks, basis, (transmittance, addition)) is None:
        return None
    small = reduced(basis, reduction)
    coefficients = light_of_samples(samples, found, small, len(views))
    relit = in_mean_light(samples, found, small, coefficients)
    steady = guide_in_mean_light(guide, basis, addition, coefficients)
    second = estimate(relit, steady, detection.opaque, detection.mask, found.falloff)
    left = _squares_left(relit, second, small) / _squares_left(samples, found, small)
    if math.isnan(left):
        return None
    if left < MOST_LEFT:
        return SecondEstimate(second, steady, left)
    follows = follows_light(samples, found, small[..., :1], reduced(guide[..., :3], reduction), coefficients)
    if not follows.any():
        return SecondEstimate(found, guide, left)
    second = estimate(samples, guide, detection.opaque, detection.mask, found.falloff, follows)
    return SecondEstimate(second, guide, left)


def light_of_samples(samples: PointSamples, found: LayerEstimate, basis: Tensor, views: int) -> Tensor:
    """Fit the light of each view to what an estimate leaves of the samples.

    By robust least squares, I - F (T C + B) = F B (basis coefficients_i), the linear part of the light, over samples
    where the artifact hides more than it shows. Coefficients are expected to vary as those of all views do (empirical
    Bayes), so that a view with few samples has a light near the mean.

    Args:
        samples: of the points.
        found: an estimate from them, with the points' colors.
        basis: [h, w, 3] at the working resolution (`overlay.shading.shading_basis`).
        views: their number V.

    Returns:
        Coefficients [V, COEFFICIENTS], of mean 0 over the views.
    """
    hides = _hides(samples, basis)
    pixel, view = samples.pixel[hides], samples.view[hides]
    left, terms = found.left_of(samples, hides), _terms(basis, found, pixel)
    coefficients = left.new_zeros(views, COEFFICIENTS)
    variance = torch.full((COEFFICIENTS,), MAX_COEFFICIENT**2, device=left.device, dtype=torch.float64)
    for _ in range(ROUNDS if len(hides) else 0):
        residual = left - _change(terms, coefficients[view])
        scale = robust_deviation(residual)
        weight = 1 / (1 + residual.square().mean(dim=-1) / (OUTLIER_SCALE * scale) ** 2)
        precision = (weight / scale**2)[:, None, None] * terms
        products = summed(view, (precision.mT @ terms).flatten(1).double(), views).unflatten(1, (COEFFICIENTS, -1))
        sums = summed(view, (precision * left[..., None]).sum(dim=1).double(), views)
        uncertainty = torch.linalg.inv(products + torch.diag(1 / variance))
        solution = (uncertainty @ sums[..., None])[..., 0]
        variance = (solution.square() + uncertainty.diagonal(dim1=1, dim2=2)).mean(dim=0)
        coefficients = solution.to(left)
    coefficients = coefficients.clamp(-MAX_COEFFICIENT, MAX_COEFFICIENT)
    return coefficients - coefficients.mean(dim=0)


def in_mean_light(samples: PointSamples, found: LayerEstimate, basis: Tensor, coefficients: Tensor) -> PointSamples:
    """The samples without what their views' coefficients [V, COEFFICIENTS] add to the artifact's mean light."""
    lit = (basis.reshape(-1, 3)[samples.pixel, 0] > 0).nonzero()[:, 0]
    color = samples.color.clone()
    color[lit] -= _change(_terms(basis, found, samples.pixel[lit]), coefficients[samples.view[lit]])
    return replace(samples, color=color.clamp(0, 1)).ordered()


def guide_in_mean_light(guide: Tensor, basis: Tensor, addition: Tensor, coefficients: Tensor) -> Tensor:
    """Mean and deviation of the photos [H, W, 4] in the mean light, of which their mean is.

    Args:
        guide: those of the photos as they are.
        basis: [H, W, 3].
        addition: B, likewise.
        coefficients: of the photos [V, COEFFICIENTS].
    """
    deviation = guide[..., 3:]
    gains, slopes = coefficients.split((3, 2), dim=1)
    variance = torch.zeros_like(deviation)
    for channel in range(3):
        covariance = torch.cov(torch.cat([gains[:, channel, None], slopes], dim=1).T, correction=0)
        own = addition[..., channel, None].square() * (basis @ covariance * basis).sum(dim=-1, keepdim=True)
        variance = torch.maximum(variance, own)
    steady = (deviation.square() - variance).clamp_min(0).sqrt()
    return torch.cat([guide[..., :3], torch.where(deviation == UNKNOWN_DEVIATION, deviation, steady)], dim=-1)


def _squares_left(samples: PointSamples, found: LayerEstimate, basis: Tensor) -> float:
    """Squared robust deviation of what an estimate leaves of the samples where the artifact hides; NaN without any."""
    return float(robust_deviation(found.left_of(samples, _hides(samples, basis)))) ** 2


def _hides(samples: PointSamples, basis: Tensor) -> Tensor:
    """Indices of the samples where the artifact hides more than it shows."""
    return (basis.reshape(-1, 3)[samples.pixel, 0] > HIDING).nonzero()[:, 0]


def _terms(basis: Tensor, found: LayerEstimate, pixel: Tensor) -> Tensor:
    """[S, 3, COEFFICIENTS]: what a view's coefficients are multiplied by at working pixels [S]."""
    addition = (found.falloff * found.addition).reshape(-1, 3)[pixel]
    own, slopes = basis.reshape(-1, 3)[pixel].split((1, 2), dim=-1)
    return affine_terms(addition * own, addition, slopes)


def _change(terms: Tensor, coefficients: Tensor) -> Tensor:
    """Change of colors [S, 3] by coefficients [S, COEFFICIENTS]."""
    return (terms @ coefficients[..., None])[..., 0]
