"""gsplat's CUDA kernels behind the signature of `interface.rasterization_with`.

The same sequence of gsplat's public operators as `gsplat.rasterization`, less one thing: that function inverts the view
matrix with `torch.inverse`, which waits for the device at every frame. A rigid matrix needs no solver.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from gsplat import (
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    rasterize_to_pixels,
    spherical_harmonics,
)
from torch import Tensor

from ssa_nerfstudio.rasterization import constants


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, 3] or [N, K, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = constants.NEAR_PLANE,
    far_plane: float = constants.FAR_PLANE,
    radius_clip: float = 0.0,
    eps2d: float = constants.EPS2D,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = constants.TILE,
    backgrounds: Tensor | None = None,  # [C, 3]
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw N Gaussians into C pinhole cameras with rigid view matrices. See `interface.rasterization_with`."""
    if packed or sparse_grad:
        raise ValueError("packed and sparse_grad are not supported; leave them out")
    n_cameras = viewmats.shape[0]
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        means,
        None,
        quats,
        scales,
        viewmats,
        Ks,
        width,
        height,
        eps2d=eps2d,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        calc_compensations=rasterize_mode == "antialiased",
    )
    alphas = opacities.expand(n_cameras, -1)
    if compensations is not None:
        alphas = alphas * compensations
    if sh_degree is None:
        rgb = colors.expand(n_cameras, -1, -1)
    else:
        centers = -(viewmats[:, :3, :3].transpose(1, 2) @ viewmats[:, :3, 3:])  # [C, 3, 1]
        directions = means - centers.transpose(1, 2)
        rgb = spherical_harmonics(sh_degree, directions, colors.expand(n_cameras, -1, -1, -1), masks=radii > 0)
        rgb = torch.clamp_min(rgb + 0.5, 0.0)
    channels = rgb
    if render_mode != "RGB":
        channels = depths[..., None] if render_mode in ("D", "ED") else torch.cat([rgb, depths[..., None]], dim=-1)
        if backgrounds is not None:
            backgrounds = torch.cat([backgrounds, backgrounds.new_zeros(n_cameras, 1)], dim=-1)
            backgrounds = backgrounds[:, -channels.shape[-1] :]
    tiles = math.ceil(width / tile_size), math.ceil(height / tile_size)
    _, isect_ids, flatten_ids = isect_tiles(
        means2d, radii, depths, tile_size, *tiles, packed=False, n_cameras=n_cameras
    )
    offsets = isect_offset_encode(isect_ids, n_cameras, *tiles)
    render, alpha = rasterize_to_pixels(
        means2d,
        conics,
        channels,
        alphas.contiguous(),
        width,
        height,
        tile_size,
        offsets,
        flatten_ids,
        backgrounds=backgrounds,
        absgrad=absgrad,
    )
    if render_mode.endswith("ED"):
        render = torch.cat([render[..., :-1], render[..., -1:] / alpha.clamp_min(1e-10)], dim=-1)
    info = {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": radii,
        "means2d": means2d,
        "width": width,
        "height": height,
        "tile_size": tile_size,
        "n_cameras": n_cameras,
    }
    return render, alpha, info
