"""The Gaussians that a training starts from."""

from __future__ import annotations

import torch
from nerfstudio.models.splatfacto import RGB2SH
from torch import Tensor

from ssa_nerfstudio.rasterization.constants import NEAR_PLANE

MIN_DISTANCE = NEAR_PLANE
"""A seed point nearer to a camera than this (world units) is inside it: that camera never draws it."""


def outside_cameras(means: Tensor, positions: Tensor) -> Tensor:
    """[N] bool, True where a seed point [N, 3] is inside none of the cameras at positions [V, 3]."""
    inside = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    for chunk in positions.to(means).split(64):
        inside |= (torch.cdist(means, chunk) < MIN_DISTANCE).any(dim=1)
    return ~inside


def color_parameters(colors: Tensor, sh_degree: int) -> Tensor:
    """Constant spherical harmonics, or logits without harmonics, [N, 3] of colors [N, 3] uint8."""
    values = colors.float() / 255.0
    return RGB2SH(values) if sh_degree > 0 else torch.logit(values, eps=1e-6)
