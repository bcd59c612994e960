"""The light on an artifact in each photo, from how photos differ where it hides the scene."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.point_samples import working_reduction
from ssa_nerfstudio.evidence.statistics import FULL_SCALE
from ssa_nerfstudio.overlay.shading import COEFFICIENTS

MIN_OPACITY = 0.5
"""Of the pixels that count: the artifact's light is at least as much as the scene's."""
MAX_COEFFICIENT = 1.0
"""Of a coefficient: a factor of 2.7 in the brightness of what is opaque; beyond it, something else is there."""


@torch.no_grad()
def artifact_light(images: Sequence[Tensor], masks: Sequence[Tensor | None], basis: Tensor, addition: Tensor) -> Tensor:
    """Fit the coefficients of each photo's shading.

    By least squares, I_i - mean(I) = B (basis coefficients_i), the linear part of the light. What the scene changes
    where it comes through is taken for light, too, so this is a start and no more.

    Args:
        images: photos behind the same artifact, [H, W, 3 or 4] of one size.
        masks: of each photo [H, W, 1], 0 where it does not count; None for none.
        basis: [H, W, 3] (`overlay.shading.shading_basis`).
        addition: B of the artifact [H, W, 3] in the mean light.

    Returns:
        [V, COEFFICIENTS] on the device of the basis, of mean 0 over the photos; 0 where no pixel is hidden.
    """
    reduction = working_reduction(*basis.shape[:2])
    basis, addition = reduced(basis, reduction), reduced(addition, reduction)
    counts = basis[..., 0] > MIN_OPACITY
    if not counts.any():
        return basis.new_zeros(len(images), COEFFICIENTS)
    own, slopes = basis[counts].split((1, 2), dim=-1)
    light = addition[counts]
    # [N, 3 channels, 5]: a gain for each channel, slopes for all.
    terms = torch.cat([torch.diag_embed(light * own), light[..., None] * slopes[:, None]], dim=-1).double()
    shown = torch.stack([_at(image[..., :3], counts, reduction) / FULL_SCALE.get(image.dtype, 1.0) for image in images])
    weights = torch.stack([_weight(mask, counts, reduction) for mask in masks])
    mean = (weights * shown).sum(dim=0) / weights.sum(dim=0).clamp_min(1)
    squares = torch.einsum("nci,ncj->nij", terms, terms)  # once: for each photo it would be large
    products = torch.einsum("vn,nij->vij", weights[..., 0].double(), squares)
    ridge = 1e-6 * products.diagonal(dim1=1, dim2=2).amax(dim=1).clamp_min(1e-12)
    products += ridge[:, None, None] * torch.eye(COEFFICIENTS, dtype=products.dtype, device=products.device)
    sums = torch.einsum("vnc,nci->vi", (weights * (shown - mean)).double(), terms)
    found = torch.linalg.solve(products.cpu(), sums.cpu()).clamp(-MAX_COEFFICIENT, MAX_COEFFICIENT).to(basis)
    return found - found.mean(dim=0)


def _at(image: Tensor, counts: Tensor, reduction: int) -> Tensor:
    """Pixels [N, C] of an image [H, W, C] that count, on the device of `counts` [h, w]."""
    return reduced(image.float(), reduction).to(counts.device)[counts]


def _weight(mask: Tensor | None, counts: Tensor, reduction: int) -> Tensor:
    """[N, 1]: 1 where a photo counts, elsewhere 0."""
    if mask is None:
        return torch.ones(int(counts.sum()), 1, device=counts.device)
    return (_at((mask != 0).reshape(*mask.shape[:2], 1), counts, reduction) == 1).float()
