"""The reference rasterizer: a loop over tiles in plain torch, differentiated by autograd, in any float dtype.

It is slow and defines what the other implementations compute; tests and the rasterizer benchmark compare them with it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.rasterization.constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN
from ssa_nerfstudio.rasterization.interface import make_rasterization
from ssa_nerfstudio.rasterization.projection import Splats, project
from ssa_nerfstudio.rasterization.splatting import project_and_blend


def blend(
    splats: Splats, means2d: Tensor, camera: int, width: int, height: int, absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Blend a camera's splats, front to back: C = sum_i c_i alpha_i prod_{j<i} (1 - alpha_j). See `splatting.Blend`.

    Raises:
        InputError: with `absgrad`; autograd sums gradients, not their magnitudes.
    """
    if absgrad:
        raise InputError(
            "the reference rasterizer has no absgrad", "set use_absgrad to False or use the cpu rasterizer"
        )
    centers = means2d[camera, splats.ids]
    image = centers.new_zeros(height, width, 4)
    alpha = centers.new_zeros(height, width, 1)
    lower = torch.floor((centers.detach() - splats.radii[:, None]) / TILE)
    upper = torch.ceil((centers.detach() + splats.radii[:, None]) / TILE)
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            column, row = left // TILE, top // TILE
            touches = (lower[:, 0] <= column) & (upper[:, 0] > column) & (lower[:, 1] <= row) & (upper[:, 1] > row)
            here = torch.nonzero(touches).squeeze(-1)
            bottom, right = min(top + TILE, height), min(left + TILE, width)
            color, opaque = _blend_tile(splats, centers, here, top, bottom, left, right)
            image[top:bottom, left:right] = color
            alpha[top:bottom, left:right] = opaque
    return image, alpha


def _blend_tile(
    splats: Splats, centers: Tensor, here: Tensor, top: int, bottom: int, left: int, right: int
) -> tuple[Tensor, Tensor]:
    """Color [h, w, 4] and alpha [h, w, 1] of one tile that the splats `here` [n], nearest first, touch."""
    y = torch.arange(top, bottom, dtype=centers.dtype, device=centers.device) + 0.5
    x = torch.arange(left, right, dtype=centers.dtype, device=centers.device) + 0.5
    dx = x[None, None, :] - centers[here, 0, None, None]
    dy = y[None, :, None] - centers[here, 1, None, None]
    xx, xy, yy = (splats.conics[here, k, None, None] for k in range(3))
    sigma = 0.5 * (xx * dx**2 + yy * dy**2) + xy * dx * dy  # [n, h, w]
    alphas = (splats.opacities[here, None, None] * torch.exp(-sigma)).clamp_max(ALPHA_MAX)
    alphas = torch.where((sigma >= 0) & (alphas >= ALPHA_MIN), alphas, torch.zeros_like(alphas))
    # The splat that would reduce the transmittance to the threshold is not drawn, nor any behind it.
    after = torch.cumprod(1.0 - alphas, dim=0)
    alphas = torch.where(after > TRANSMITTANCE_MIN, alphas, torch.zeros_like(alphas))
    after = torch.cumprod(1.0 - alphas, dim=0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]]) if len(here) else after
    weights = alphas * before
    color = torch.einsum("nhw,nc->hwc", weights, splats.colors[here])
    return color, weights.sum(dim=0)[..., None]


rasterization = make_rasterization(project_and_blend(project, blend))
