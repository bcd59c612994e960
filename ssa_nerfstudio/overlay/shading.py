"""The light on an artifact, as a factor of its own light B: its logarithm changes linearly over the artifact, its tint
does not."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.resampling import to_training_scale

ShadingSetting = Literal["auto", "off", "affine"]
"""Which photos have a light of their own: those of an artifact on which it changes, none, or all."""
COEFFICIENTS = 5
"""Number of coefficients: logarithms of the gains of red, green and blue in the middle of an opaque artifact, and their
change to the right and downwards per standard deviation of its extent. Less where less is opaque."""
_HALF_WIDTH = math.sqrt(3)
"""Of an artifact of constant opacity, standard deviations of its extent."""


def shading_basis(opacity: Tensor) -> Tensor:
    """What the coefficients of a photo are multiplied by, [h, w, 3]: the opacity, and it times both coordinates.

    So the light changes least where the estimate of the opacity is mostly noise.

    Args:
        opacity: of the artifact [h, w, 1] in [0, 1].
    """
    coordinates = coordinates_of(opacity)
    return torch.cat([opacity, opacity * coordinates], dim=-1)


def coordinates_of(opacity: Tensor) -> Tensor:
    """To the right and downwards from an artifact's middle, [h, w, 2], in standard deviations of its extent.

    Args:
        opacity: of the artifact [h, w, 1] in [0, 1].

    Returns:
        At most the square root of 3 in size: the light stays the same beyond.
    """
    height, width = opacity.shape[:2]
    rows = torch.arange(height, dtype=opacity.dtype, device=opacity.device)[:, None, None]
    columns = torch.arange(width, dtype=opacity.dtype, device=opacity.device)[None, :, None]
    total = opacity.sum().clamp_min(torch.finfo(opacity.dtype).tiny)
    coordinates = []
    for place in (columns, rows):
        offset = place - (opacity * place).sum() / total
        deviation = ((opacity * offset.square()).sum() / total).sqrt().clamp_min(0.5)  # of an artifact of one pixel
        coordinates.append((offset / deviation).clamp(-_HALF_WIDTH, _HALF_WIDTH).expand_as(opacity))
    return torch.cat(coordinates, dim=-1)


def basis_of(overlay: ScreenSpaceOverlay, reduction: int = 1) -> Tensor:
    """The basis of an overlay's opacity as the training started, which checkpoints hold.

    Args:
        overlay: the artifact's.
        reduction: factor by which training images are reduced.

    Returns:
        [H // reduction, W // reduction, 3], see `shading_basis`.
    """
    basis = shading_basis(1 - overlay.evidence)
    return to_training_scale(basis, overlay.resolution, reduction, overlay.height, overlay.width)


def light(basis: Tensor, coefficients: Tensor) -> Tensor:
    """The factor of B in a photo, [h, w, 3], above 0.

    Args:
        basis: [h, w, 3] (`shading_basis`).
        coefficients: of the photo [COEFFICIENTS].
    """
    gains, slopes = coefficients.split((3, 2))
    return torch.exp(basis @ torch.cat([gains[None], slopes[:, None].expand(2, 3)]))
