"""The light on an artifact in each photo, from how photos differ where it hides the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.layer_estimate import MIN_OPACITY, MIN_SHARE
from ssa_nerfstudio.evidence.point_samples import working_reduction
from ssa_nerfstudio.evidence.scene_photos import MAX_VIEWS
from ssa_nerfstudio.evidence.statistics import FULL_SCALE
from ssa_nerfstudio.overlay.shading import COEFFICIENTS

HIDING = 0.5
"""Opacity above which a pixel counts: the artifact's light is at least as much as the scene's."""
MAX_COEFFICIENT = 1.0
"""Of a coefficient: a factor of 2.7 in the brightness of what is opaque; beyond it, something else is there."""
SCENE_DEVIATIONS = 2.0
"""By how many of its standard deviations the scene behind an artifact may differ from photo to photo."""
MIN_EXPLAINED = 0.05
"""Share of what the scene does not explain from which on the light changes: in constant light at most 0.031 of 16
measured starts, on fingers in changing light at least 0.055; behind what moves 0.035 to 0.195."""

MAX_PIXELS = 4096
"""Of those that count, and of those that show the scene, a regular subset: light is smooth."""
_LIGHT, _SCENE = slice(0, COEFFICIENTS), slice(COEFFICIENTS, None)
"""Terms of both."""


@dataclass(frozen=True)
class ArtifactLight:
    """The light on an artifact in each of V photos."""

    coefficients: Tensor
    """[V, COEFFICIENTS], of mean 0 over the photos (`overlay.shading`); 0 where no pixel is hidden."""
    explained: float
    """Of the squares that the scene leaves of the photos' differences, and of those by which it is uncertain, the share
    that light explains, in [0, 1]; 0 where no pixel is hidden, or hardly one shows the scene."""
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

    By least squares, I_i - mean(I) = B (basis coefficients_i), the linear part of the light. Where the scene comes
    through, it changes the photos in proportion to T, which is not known better than MIN_OPACITY. So squares are
    divided by T^2 + MIN_OPACITY^2.

    Light is judged beside a scene of as many coefficients, T (own gains and slopes of the photo), each at most
    SCENE_DEVIATIONS of the scene's own: of the squares that the scene leaves, the share that light explains, alone or
    with another scene. To them are added those of a scene that comes through by MIN_OPACITY more than T says, because
    T is not known better.

    Args:
        images: photos behind the same artifact, [H, W, 3 or 4] of one size.
        masks: of each photo [H, W, 1], 0 where it does not count; None for none.
        basis: [H, W, 3] (`overlay.shading.shading_basis`).
        layers: of the artifact in the mean light, T [H, W, 1 or 3] and B [H, W, 3].

    Returns:
        Coefficients on the device of the basis, and whether they are more than chance.
    """
    reduction = working_reduction(*basis.shape[:2])
    basis = reduced(basis, reduction)
    transmittance, addition = (reduced(layer, reduction) for layer in layers)
    counts = basis[..., 0] > HIDING
    hidden = float(counts.float().mean())
    if not hidden:
        return ArtifactLight(basis.new_zeros(len(images), COEFFICIENTS), 0.0, 0.0)
    pixels, others = (_regular_subset(each.flatten().nonzero()[:, 0]) for each in (counts, ~counts))
    own, slopes = basis.reshape(-1, 3)[pixels].split((1, 2), dim=-1)
    addition = addition.reshape(-1, 3)[pixels]
    through = transmittance.mean(dim=-1).reshape(-1, 1)[pixels].expand(-1, 3)
    # [N, 3 channels, 5] each: a gain for each channel, slopes for all.
    of_light = affine_terms(addition * own, addition, slopes)
    of_scene = affine_terms(through, through, slopes / own)
    terms = torch.cat([of_light, of_scene], dim=-1).double()
    shown, weights = _samples(images, masks, pixels, reduction)
    mean = (weights * shown).sum(dim=0) / weights.sum(dim=0).clamp_min(1)
    change = (weights * (shown - mean)).double()
    precision = 1 / (through[:, 0].square() + MIN_OPACITY**2)
    found = _solved(*_normal_equations(terms[..., _LIGHT], change, precision * weights[..., 0]))
    found = found.clamp(-MAX_COEFFICIENT, MAX_COEFFICIENT).to(basis)
    found = found - found.mean(dim=0)
    behind, shows = _samples(images, masks, others, reduction)
    if 1 - hidden < MIN_SHARE or not shows.any():
        return ArtifactLight(found, 0.0, hidden)  # how much the scene differs is not known
    mean = (shows * behind).sum(dim=0) / shows.sum(dim=0).clamp_min(1)
    variance = float((shows * (behind - mean).square()).sum() / (3 * shows.sum()))
    uncertain = 3 * float(weights.sum()) * MIN_OPACITY**2 * variance
    products, sums = _normal_equations(terms, change, weights[..., 0])
    explained = _share_of_light(products, sums, change.square().sum(), SCENE_DEVIATIONS * variance**0.5, uncertain)
    return ArtifactLight(found, explained, hidden)


def changing_light(
    images: Sequence[Tensor], masks: Sequence[Tensor | None], basis: Tensor, layers: tuple[Tensor, Tensor]
) -> ArtifactLight | None:
    """The light in a regular subset of at most MAX_VIEWS photos, which tell; None where it is the same in them.

    Args:
        images, masks, basis, layers: as for `artifact_light`.
    """
    if _hidden_share(basis) < MIN_SHARE:
        return None
    some = slice(None, None, -(-len(images) // MAX_VIEWS))
    found = artifact_light(images[some], masks[some], basis, layers)
    return found if found.changes else None


def affine_terms(of_gains: Tensor, of_slopes: Tensor, slopes: Tensor) -> Tensor:
    """[N, 3, 5]: what a photo's coefficients are multiplied by at a pixel and in a channel.

    Args:
        of_gains, of_slopes: factors of both [N, 3].
        slopes: [N, 2].
    """
    return torch.cat([torch.diag_embed(of_gains), of_slopes[..., None] * slopes[:, None]], dim=-1)


def _hidden_share(basis: Tensor) -> float:
    """Share of the frame that counts (`ArtifactLight.hidden`), given [H, W, 3] (`overlay.shading.shading_basis`)."""
    return float((reduced(basis[..., :1], working_reduction(*basis.shape[:2])) > HIDING).float().mean())


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


def _normal_equations(terms: Tensor, change: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Products [V, K, K] and sums [V, K] of terms [N, 3, K] and changes [V, N, 3] under weights [V, N]; on the CPU."""
    squares = torch.einsum("nci,ncj->nij", terms, terms)  # once: for each photo it would be large
    products = torch.einsum("vn,nij->vij", weights.to(terms), squares)
    return products.cpu(), torch.einsum("vnc,nci->vi", weights.to(terms)[..., None] * change, terms).cpu()


def _solved(products: Tensor, sums: Tensor, part: slice = slice(None)) -> Tensor:
    """Coefficients [V, K] of a part of the terms alone."""
    products = products[:, part, part]
    ridge = 1e-6 * products.diagonal(dim1=1, dim2=2).amax(dim=1).clamp_min(1e-12)
    identity = torch.eye(products.shape[-1], dtype=products.dtype)
    return torch.linalg.solve(products + ridge[:, None, None] * identity, sums[:, part])


def _regular_subset(pixels: Tensor) -> Tensor:
    """At most MAX_PIXELS of indices [N]."""
    return pixels[:: max(1, -(-len(pixels) // MAX_PIXELS))]


def _samples(
    images: Sequence[Tensor], masks: Sequence[Tensor | None], pixels: Tensor, reduction: int
) -> tuple[Tensor, Tensor]:
    """Working pixels of the photos, [V, N, 3] in [0, 1], and their weights [V, N, 1]: 1, or 0 where a mask is.

    Args:
        images, masks: as for `artifact_light`.
        pixels: indices [N], row by row, whose device the result is on.
        reduction: photo pixels a working pixel.
    """
    shown = [_blocks(image[..., :3], pixels, reduction) / FULL_SCALE.get(image.dtype, 1.0) for image in images]
    whole = torch.ones(len(pixels), 1, device=pixels.device)
    weights = [whole if mask is None else (_blocks((mask != 0), pixels, reduction) == 1).float() for mask in masks]
    return torch.stack(shown), torch.stack(weights)


def _blocks(image: Tensor, pixels: Tensor, reduction: int) -> Tensor:
    """Means [N, C] over the squares of an image [H, W, C] that working pixels are; the rest of it is not read."""
    height, width = image.shape[0] // reduction, image.shape[1] // reduction
    squares = image.reshape(*image.shape[:2], -1)[: height * reduction, : width * reduction]
    squares = squares.unflatten(1, (width, reduction)).unflatten(0, (height, reduction))
    at = pixels.to(image.device)
    return squares[at // width, :, at % width].float().mean(dim=(1, 2)).to(pixels.device)
