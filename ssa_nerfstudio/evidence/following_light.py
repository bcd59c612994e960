"""Where photos change with the light on the artifact: more of the artifact, which hides the scene in all of them.

Points tell what hides them by the photos that show them beside it. On a walk a point may be behind an arm in every
photo that it is seen in: then its color is the arm's, and the arm passes for scene.
"""

from __future__ import annotations

import torch
from scipy.special import fdtri
from torch import Tensor

from ssa_nerfstudio.evidence.artifact_light import HIDING
from ssa_nerfstudio.evidence.changing_area import large_parts
from ssa_nerfstudio.evidence.expected_layers import DETAIL_RADIUS
from ssa_nerfstudio.evidence.guided_upsampling import local_mean
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate
from ssa_nerfstudio.evidence.null_distribution import SIGNIFICANCE
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed
from ssa_nerfstudio.evidence.scene_photos import MAX_VIEWS
from ssa_nerfstudio.evidence.static_area import connected_parts
from ssa_nerfstudio.overlay.shading import coordinates_of


@torch.no_grad()
def follows_light(
    samples: PointSamples, found: LayerEstimate, opacity: Tensor, mean: Tensor, coefficients: Tensor
) -> Tensor:
    """Where more than half of what photos show changes with the artifact's light: bool [h, w, 1], at the working size.

    What an estimate leaves of the samples around a pixel is fitted by what they would change if all that photos show
    were the artifact: mean(I) (alpha g_i + beta h_i + gamma v_i), by least squares. Either alpha, beta and gamma are in
    the proportion in which the artifact has them, 1, x and y, or they are any, of any sign, because a highlight may lie
    elsewhere here, and what it leaves becomes darker. The fit has to be significant, and its standard deviation over
    the photos more than HIDING times that of the light; and what follows the light is connected to a large part that
    hides the scene. Samples where the estimate hides the scene, and where not, are not mixed: otherwise the rim of a
    bright artifact would follow its light.

    The errors of samples in one photo are not independent. So their covariance is that of the photos' (a sandwich
    estimator, of what a fit without a photo leaves of it), and the test is Wald's. A regular subset of at most
    MAX_VIEWS photos counts.

    Args:
        samples: of the points, as photos show them.
        found: the estimate from them, with the points' colors.
        opacity: [h, w, 1], of which the light's coordinates are.
        mean: of the photos, [h, w, 3].
        coefficients: the light in each photo, [V, COEFFICIENTS] (`mean_light.light_of_samples`).
    """
    hides = large_parts(found) > 0
    if not hides.any():
        return torch.zeros_like(opacity, dtype=torch.bool)
    every = -(-len(coefficients) // MAX_VIEWS)
    coefficients = coefficients[::every] - coefficients[::every].mean(dim=0)
    terms = torch.stack([torch.cat([coefficients[:, c, None], coefficients[:, 3:]], dim=1) for c in range(3)])
    proportional = torch.cat([torch.ones_like(opacity), coordinates_of(opacity)], dim=-1).reshape(-1, 3, 1)
    hidden = found.opacity().flatten() > HIDING
    follows, usual = torch.zeros_like(hidden), None
    for those in (hidden, ~hidden):
        left, weight = _around(samples, found, mean, those, every, len(coefficients))
        products = torch.einsum("pvc,cvi,cvj->pij", weight, terms, terms)
        sums = torch.einsum("pvc,cvi->pi", left, terms)[..., None]
        total, own = weight.sum(dim=(1, 2)), proportional[those]
        there = (own.mT @ products @ own)[:, 0, 0]
        if usual is None:
            large = hides.flatten()[those]
            usual = there[large].sum() / total[large].sum().clamp_min(1e-12)
        free = torch.eye(3).to(own).expand(len(own), 3, 3)
        for basis, full_change in ((own, there), (free, usual * total)):
            explained, certain = _fit(left, weight, terms, products, sums, basis)
            follows[those] |= certain & (explained > HIDING**2 * full_change)
    follows = follows.reshape(hides.shape)
    parts = connected_parts(follows | hides)
    return (follows & torch.isin(parts, parts[hides]))[..., None]


def _around(
    samples: PointSamples, found: LayerEstimate, mean: Tensor, those: Tensor, every: int, views: int
) -> tuple[Tensor, Tensor]:
    """What is left of the samples of each photo around each pixel, times the photos' mean color, and squares of that.

    Args:
        samples, found, mean: as for `follows_light`.
        those: working pixels whose samples count, bool [h w].
        every: of so many photos one counts.
        views: number V of these.

    Returns:
        Means over windows around these pixels, [N, V, 3 channels] each.
    """
    height, width = samples.size
    chosen = (those[samples.pixel] & (samples.view % every == 0)).nonzero()[:, 0]
    pixel, view = samples.pixel[chosen], samples.view[chosen] // every
    shown = mean.reshape(-1, 3)[pixel]
    moments = torch.cat([found.left_of(samples, chosen) * shown, shown.square()], dim=-1)
    moments = summed(pixel * views + view, moments, height * width * views)
    around = local_mean(moments.reshape(height, width, -1), DETAIL_RADIUS).reshape(height * width, views, 6)[those]
    return around[..., :3], around[..., 3:]


def _fit(
    left: Tensor, weight: Tensor, terms: Tensor, products: Tensor, sums: Tensor, basis: Tensor
) -> tuple[Tensor, Tensor]:
    """Squares that the light explains of what is left, [N], and whether they are significant, bool [N].

    Args:
        left, weight: see `_around`, [N, V, 3 channels].
        terms: gain and slopes of the light in each photo, [3 channels, V, 3].
        products, sums: of these with each other under the weights, [N, 3, 3], and with what is left, [N, 3, 1].
        basis: of the combinations of these that are fitted, [N, 3, K].
    """
    count = basis.shape[-1]
    sums = basis.mT @ sums
    inverse = torch.linalg.inv(_regular(basis.mT @ products @ basis))
    solution = inverse @ sums
    spread = basis @ inverse @ basis.mT
    # The trace of a photo's leverage: exact for one term, and too much for three.
    leverage = (weight * torch.einsum("pij,cvi,cvj->pvc", spread, terms, terms)).sum(dim=2)
    residual = left - weight * torch.einsum("pi,cvi->pvc", (basis @ solution)[..., 0], terms)
    scores = torch.einsum("pvc,cvi->pvi", residual, terms) @ basis / (1 - leverage).clamp_min(1e-3)[..., None]
    # Few photos may have most of the light, and then as few tell how certain the fit is.
    photos = leverage.sum(dim=1).square() / leverage.square().sum(dim=1).clamp_min(1e-12)
    freedom = (photos - count).clamp_min(1e-3)
    wald = (sums.mT @ torch.linalg.solve(_regular(scores.mT @ scores), sums))[:, 0, 0] / count
    # Two fits are tested.
    critical = torch.from_numpy(fdtri(count, freedom.cpu().numpy(), 1 - SIGNIFICANCE / 2)).to(wald)
    return (solution.mT @ sums)[:, 0, 0], wald * freedom / photos > critical


def _regular(matrices: Tensor) -> Tensor:
    """Symmetric matrices [N, K, K] that can be inverted."""
    ridge = 1e-6 * matrices.diagonal(dim1=1, dim2=2).amax(dim=1) + 1e-20
    return matrices + ridge[:, None, None] * torch.eye(matrices.shape[-1]).to(matrices)
