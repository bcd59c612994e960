"""The light on an artifact in each photo, from how photos differ where it hides the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.layer_estimate import MIN_OPACITY, MIN_SHARE
from ssa_nerfstudio.evidence.point_samples import working_reduction
from ssa_nerfstudio.evidence.statistics import FULL_SCALE
from ssa_nerfstudio.overlay.shading import COEFFICIENTS

HIDING = 0.5
"""Opacity above which a pixel counts: the artifact's light is at least as much as the scene's."""
MAX_COEFFICIENT = 1.0
"""Of a coefficient: a factor of 2.7 in the brightness of what is opaque; beyond it, something else is there."""
SCENE_DEVIATIONS = 2.0
"""By how many of its standard deviations the scene behind an artifact may differ from photo to photo."""
MIN_EXPLAINED = 0.05
"""Share of what the scene does not explain from which on the light changes. Where it does not, at most 0.035 is."""

MAX_PIXELS = 4096
"""Of those that count, a regular subset: light is smooth."""
_LIGHT, _SCENE = slice(0, COEFFICIENTS), slice(COEFFICIENTS, None)
"""Terms of both."""


@dataclass(frozen=True)
class ArtifactLight:
    """The light on an artifact in each of V photos."""

    coefficients: Tensor
    """[V, COEFFICIENTS], of mean 0 over the photos (`overlay.shading`); 0 where no pixel is hidden."""
    explained: float
    """How much of the photos' differences it explains, of those that the scene does not as it comes through, in [0, 1];
    0 where no pixel is hidden."""
    hidden: float
    """Share of the frame that counts, in [0, 1]. Of a spot the scene's own differences pass for light."""

    @property
    def changes(self) -> bool:
        """Whether the light is not the same in all photos."""
        return self.explained > MIN_EXPLAINED and self.hidden >= MIN_SHARE


@torch.no_grad()
def artifact_light(
    images: Sequence[Tensor], masks: Sequence[Tensor | None], basis: Tensor, layers: tuple[Tensor, Tensor]
) -> ArtifactLight:
    """Fit the coefficients of each photo's shading, and judge whether there is any.

    By least squares, I_i - mean(I) = B (basis coefficients_i), the linear part of the light. What the scene changes
    where it comes through is taken for light, too, so these are a start and no more.

    Light is judged beside a scene of as many coefficients, T (own gains and slopes of the photo), each at most
    SCENE_DEVIATIONS of the scene's own: of the squares that the scene leaves, the share that light explains, alone or
    with another scene. To them are added those of a scene that comes through by MIN_OPACITY more than T says, because
    T is not known better.

    Args:
        images: photos behind the same artifact, [H, W, 3 or 4] of one size.
        masks: of each photo [H, W, 1], 0 where it does not count; None for none.
        basis: [H, W, 3] (`overlay.shading.shading_basis`).
        layers: of the artifact in the mean light, T [H, W, 1 or 3] and B [H, W, 3].
    """
    reduction = working_reduction(*basis.shape[:2])
    basis = reduced(basis, reduction)
    transmittance, addition = (reduced(layer, reduction) for layer in layers)
    counts = basis[..., 0] > HIDING
    if not counts.any():
        return ArtifactLight(basis.new_zeros(len(images), COEFFICIENTS), 0.0, 0.0)
    pixels, others = (each.flatten().nonzero()[:, 0] for each in (counts, ~counts))
    pixels = pixels[:: -(-len(pixels) // MAX_PIXELS)]
    own, slopes = basis.reshape(-1, 3)[pixels].split((1, 2), dim=-1)
    addition = addition.reshape(-1, 3)[pixels]
    through = transmittance.mean(dim=-1).reshape(-1, 1)[pixels].expand(-1, 3)
    # [N, 3 channels, 5] each: a gain for each channel, slopes for all.
    of_light = _terms(addition * own, addition, slopes)
    of_scene = _terms(through, through, slopes / own)
    terms = torch.cat([of_light, of_scene], dim=-1).double()
    shown, variance = _read(images, pixels, others, reduction)
    weights = torch.stack([_weight(mask, pixels, reduction) for mask in masks])
    mean = (weights * shown).sum(dim=0) / weights.sum(dim=0).clamp_min(1)
    change = (weights * (shown - mean)).double()
    squares = torch.einsum("nci,ncj->nij", terms, terms)  # once: for each photo it would be large
    products = torch.einsum("vn,nij->vij", weights[..., 0].double(), squares).cpu()
    sums = torch.einsum("vnc,nci->vi", change, terms).cpu()
    found = _solved(products, sums, _LIGHT).clamp(-MAX_COEFFICIENT, MAX_COEFFICIENT).to(basis)
    uncertain = 3 * float(weights.sum()) * MIN_OPACITY**2 * variance
    explained = _share_of_light(products, sums, change.square().sum(), SCENE_DEVIATIONS * variance**0.5, uncertain)
    return ArtifactLight(found - found.mean(dim=0), explained, float(counts.float().mean()))


def _share_of_light(products: Tensor, sums: Tensor, total: Tensor, bound: float, uncertain: float) -> float:
    """Of the squares that the scene leaves, the share that light explains, alone or with another scene.

    Args:
        products: of the terms with each other [V, 10, 10], _LIGHT before _SCENE.
        sums: of the terms with the photos' differences [V, 10].
        total: squares of these [].
        bound: of the scene's coefficients.
        uncertain: squares that are added to those that the scene leaves.
    """
    scene = _solved(products, sums, _SCENE).clamp(-bound, bound)
    by_scene = (products[:, :, _SCENE] @ scene[..., None])[..., 0]
    left = float(total + (scene * (by_scene - 2 * sums)[:, _SCENE]).sum()) + uncertain
    sums = sums - by_scene
    alone, other_scene, together = (
        float((sums[:, part] * _solved(products, sums, part)).sum()) for part in (_LIGHT, _SCENE, slice(None))
    )
    return min(max(alone, together - other_scene, 0.0) / max(left, 1e-12), 1.0)


def _terms(of_gains: Tensor, of_slopes: Tensor, slopes: Tensor) -> Tensor:
    """[N, 3, 5]: what a photo's coefficients are multiplied by at a pixel and in a channel.

    Args:
        of_gains, of_slopes: factors of both [N, 3].
        slopes: [N, 2].
    """
    return torch.cat([torch.diag_embed(of_gains), of_slopes[..., None] * slopes[:, None]], dim=-1)


def _solved(products: Tensor, sums: Tensor, part: slice) -> Tensor:
    """Coefficients [V, K] of a part of the terms alone."""
    products = products[:, part, part]
    ridge = 1e-6 * products.diagonal(dim1=1, dim2=2).amax(dim=1).clamp_min(1e-12)
    identity = torch.eye(products.shape[-1], dtype=products.dtype)
    return torch.linalg.solve(products + ridge[:, None, None] * identity, sums[:, part])


def _read(images: Sequence[Tensor], pixels: Tensor, others: Tensor, reduction: int) -> tuple[Tensor, float]:
    """Some working pixels of the photos, [V, N, 3] in [0, 1], and the mean variance of others; 0 where there are none.

    Args:
        images: [H, W, 3 or 4] each.
        pixels: indices [N], row by row, whose device the result is on.
        others: indices [M].
        reduction: photo pixels a working pixel.
    """
    shown, mean, square = [], 0.0, 0.0
    for image in images:
        photo = reduced(image[..., :3].float(), reduction).reshape(-1, 3) / FULL_SCALE.get(image.dtype, 1.0)
        shown.append(photo[pixels.to(photo.device)].to(pixels.device))
        behind = photo[others.to(photo.device)]
        mean, square = mean + behind / len(images), square + behind.square() / len(images)
    variance = torch.as_tensor(square) - torch.as_tensor(mean).square()
    return torch.stack(shown), float(variance.clamp_min(0).mean()) if len(others) else 0.0


def _weight(mask: Tensor | None, pixels: Tensor, reduction: int) -> Tensor:
    """[N, 1]: 1 where a photo counts, elsewhere 0."""
    if mask is None:
        return torch.ones(len(pixels), 1, device=pixels.device)
    whole = reduced((mask != 0).reshape(*mask.shape[:2], 1).float(), reduction).flatten()
    return (whole[pixels.to(whole.device)].to(pixels.device) == 1).float()[:, None]
