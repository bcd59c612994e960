"""Where photos change with the light on the artifact: more of the artifact, which hides the scene in all of them.

Points tell what hides them by the photos that show them beside it. On a walk a point may be behind an arm in every
photo that it is seen in: then its color is the arm's, and the arm passes for scene.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from scipy.special import fdtri
from torch import Tensor

from ssa_nerfstudio.evidence.artifact_light import HIDING
from ssa_nerfstudio.evidence.changing_area import large_parts
from ssa_nerfstudio.evidence.detection import SIGNIFICANCE
from ssa_nerfstudio.evidence.expected_layers import DETAIL_RADIUS
from ssa_nerfstudio.evidence.guided_upsampling import local_mean
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed
from ssa_nerfstudio.evidence.scene_photos import MAX_VIEWS
from ssa_nerfstudio.overlay.shading import coordinates_of


@torch.no_grad()
def follows_light(
    samples: PointSamples, found: LayerEstimate, opacity: Tensor, mean: Tensor, coefficients: Tensor
) -> Tensor:
    """Where more than half of what photos show changes with the artifact's light: bool [h, w, 1], at the working size.

    What an estimate leaves of the samples around a pixel, as a share of the photos' mean color, is fitted by the
    artifact's light, whose coefficients are known: a g_i + b h_i + c v_i, by least squares. Either a, b and c are in
    the proportion in which the artifact has them, 1, x and y, or they are any, because a highlight may lie elsewhere
    here. The fit has to be significant, and its deviation more than HIDING times that of the light; and what follows
    the light is connected to a large part that hides the scene.

    The errors of samples in one photo are not independent. So their covariance is that of the photos' (a sandwich
    estimator), and the test is Wald's. A regular subset of at most MAX_VIEWS photos counts.

    Args:
        samples: of the points, as photos show them.
        found: the estimate from them, with the points' colors.
        opacity: [h, w, 1], of which the light's coordinates are.
        mean: of the photos, [h, w, 3].
        coefficients: the light in each photo, [V, COEFFICIENTS] (`mean_light.light_of_samples`).
    """
    hides = large_parts(found)
    if not hides.any():
        return torch.zeros_like(opacity, dtype=torch.bool)
    every = -(-len(coefficients) // MAX_VIEWS)
    coefficients = coefficients[::every]
    left, weight = _around(samples, found, mean, every, len(coefficients))
    terms = torch.stack([torch.cat([coefficients[:, c, None], coefficients[:, 3:]], dim=1) for c in range(3)])
    products = torch.einsum("pvc,cvi,cvj->pij", weight, terms, terms)
    total = weight.sum(dim=(1, 2)).clamp_min(1e-12)
    place = torch.cat([torch.ones_like(opacity), coordinates_of(opacity)], dim=-1).reshape(-1, 3, 1)
    own = (place.mT @ products @ place)[:, 0, 0]
    inside = torch.from_numpy(hides).flatten().to(own.device)
    usual = total * own[inside].sum() / total[inside].sum()
    follows = torch.zeros_like(inside)
    for basis, full in ((place, own), (torch.eye(3).to(place).expand(len(place), 3, 3), usual)):
        explained, certain = _fit(left, weight, terms, products, basis)
        follows |= certain & (explained > HIDING**2 * full)
    joined = _connected(follows.reshape(hides.shape).cpu().numpy(), hides)
    return torch.from_numpy(joined).to(mean.device)[..., None]


def _around(samples: PointSamples, found: LayerEstimate, mean: Tensor, every: int, views: int) -> tuple[Tensor, Tensor]:
    """What is left of the samples of each photo around each pixel, times the photos' mean color, and squares of that.

    Args:
        samples, found, mean: as for `follows_light`.
        every: so many photos are one that counts.
        views: number V of these.

    Returns:
        Means over windows, [h w, V, 3 channels] each.
    """
    height, width = samples.size
    those = (samples.view % every == 0).nonzero()[:, 0]
    pixel, view = samples.pixel[those], samples.view[those] // every
    shown = mean.reshape(-1, 3)[pixel]
    moments = torch.cat([found.left_of(samples, those) * shown, shown.square()], dim=-1)
    moments = summed(pixel * views + view, moments, height * width * views)
    around = local_mean(moments.reshape(height, width, -1), DETAIL_RADIUS).reshape(height * width, views, 6)
    return around[..., :3], around[..., 3:]


def _fit(left: Tensor, weight: Tensor, terms: Tensor, products: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Squares that the light explains of what is left, [N], and whether they are significant, bool [N].

    Args:
        left, weight: see `_around`, [N, V, 3 channels].
        terms: gain and slopes of the light in each photo, [3 channels, V, 3].
        products: of these under the weights, [N, 3, 3].
        basis: of the combinations of these that are fitted, [N, 3, K].
    """
    count = basis.shape[-1]
    sums = basis.mT @ torch.einsum("pvc,cvi->pi", left, terms)[..., None]
    products = basis.mT @ products @ basis
    solution = torch.linalg.solve(_regular(products), sums)
    residual = left - weight * torch.einsum("pi,cvi->pvc", (basis @ solution)[..., 0], terms)
    scores = torch.einsum("pvc,cvi->pvi", residual, terms) @ basis
    photos = weight.sum(dim=2)
    photos = photos.sum(dim=1).square() / photos.square().sum(dim=1).clamp_min(1e-12)
    unknown = (photos - count).clamp_min(1e-3)
    wald = (sums.mT @ torch.linalg.solve(_regular(scores.mT @ scores), sums))[:, 0, 0] * unknown / (count * photos)
    certain = torch.from_numpy(fdtri(count, unknown.cpu().numpy(), 1 - SIGNIFICANCE)).to(wald)
    return (solution.mT @ sums)[:, 0, 0], wald > certain


def _regular(matrices: Tensor) -> Tensor:
    """Symmetric matrices [N, K, K] that can be inverted."""
    ridge = 1e-6 * matrices.diagonal(dim1=1, dim2=2).amax(dim=1) + 1e-20
    return matrices + ridge[:, None, None] * torch.eye(matrices.shape[-1]).to(matrices)


def _connected(follows: np.ndarray, hides: np.ndarray) -> np.ndarray:
    """What of an area is connected to another, at most through itself: bool [h, w]."""
    parts = cv2.connectedComponents((follows | hides).astype(np.uint8), connectivity=8)[1]
    return follows & np.isin(parts, np.setdiff1d(parts[hides], 0))
