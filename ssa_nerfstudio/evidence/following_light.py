"""Where photos change as the light on the artifact does: more of the artifact, which hides the scene in all of them.

Points tell what hides them by the photos that show them beside it. On a walk a point may be behind an arm in every
photo that it is seen in: then its color is the arm's, and the arm passes for scene.
"""

from __future__ import annotations

from statistics import NormalDist

import cv2
import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio.evidence.artifact_light import HIDING, affine_terms
from ssa_nerfstudio.evidence.changing_area import large_parts
from ssa_nerfstudio.evidence.detection import SIGNIFICANCE
from ssa_nerfstudio.evidence.expected_layers import DETAIL_RADIUS
from ssa_nerfstudio.evidence.guided_upsampling import local_mean
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed
from ssa_nerfstudio.overlay.shading import coordinates_of

CERTAIN = NormalDist().inv_cdf(1 - SIGNIFICANCE)
"""Standard errors above which a share is more than chance."""


@torch.no_grad()
def follows_light(
    samples: PointSamples, found: LayerEstimate, opacity: Tensor, mean: Tensor, coefficients: Tensor
) -> Tensor:
    """Where more than half of what photos show changes with the artifact's light: bool [h, w, 1], at the working size.

    What an estimate leaves of the samples is a share s of what would change if all that photos show were the artifact:
    I - F (T C + B) = s mean(I) (g_i + x h_i + y v_i), by least squares over a window. The errors of samples in one
    photo are not independent, so the standard error goes by photos (a sandwich estimator). It counts where s is more
    than HIDING and significant, and what counts is connected to a large part that hides the scene.

    Args:
        samples: of the points, as photos show them.
        found: the estimate from them, with the points' colors.
        opacity: [h, w, 1], of which the light's coordinates are.
        mean: of the photos, [h, w, 3].
        coefficients: the light in each photo, [V, COEFFICIENTS] (`mean_light.light_of_samples`).
    """
    height, width = samples.size
    left = found.left_of(samples, torch.arange(len(samples.pixel), device=samples.pixel.device))
    shown = mean.reshape(-1, 3)[samples.pixel]
    terms = affine_terms(shown, shown, coordinates_of(opacity).reshape(-1, 2)[samples.pixel])
    change = (terms @ coefficients[samples.view][..., None])[..., 0]
    products = torch.stack([left * change, change.square()], dim=1).sum(dim=-1)
    place = samples.pixel * len(coefficients) + samples.view
    of_photos = summed(place, products, height * width * len(coefficients)).reshape(height, width, -1)
    product, square = local_mean(of_photos, DETAIL_RADIUS).unflatten(-1, (-1, 2)).unbind(dim=-1)
    total = square.sum(dim=-1, keepdim=True).clamp_min(1e-12)
    share = product.sum(dim=-1, keepdim=True) / total
    error = (product - share * square).square().sum(dim=-1, keepdim=True).sqrt() / total
    # Of few photos these may agree by chance: at least that of independent noise.
    window = (2 * DETAIL_RADIUS + 1) ** 2
    error = torch.maximum(error, found.noise / (window * total).sqrt())
    follows = ((share > HIDING) & (share > CERTAIN * error))[..., 0].cpu().numpy()
    hides = large_parts(found)
    parts = cv2.connectedComponents((follows | hides).astype(np.uint8), connectivity=8)[1]
    joined = follows & np.isin(parts, np.setdiff1d(parts[hides], 0))
    return torch.from_numpy(joined).to(mean.device)[..., None]
