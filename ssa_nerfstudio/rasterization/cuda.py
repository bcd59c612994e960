"""gsplat's CUDA kernels behind `interface.make_rasterization`.

The same sequence of gsplat's public operators as `gsplat.rasterization`, with two differences. That function inverts
the view matrix with `torch.inverse`, which waits for the device at every frame; a rigid matrix needs no solver. And
`tile_lists` lists the Gaussians of each tile.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from gsplat import fully_fused_projection, rasterize_to_pixels, spherical_harmonics
from gsplat.cuda._wrapper import _RasterizeToPixels
from torch import Tensor

from ssa_nerfstudio.rasterization.constants import TILE
from ssa_nerfstudio.rasterization.interface import Cameras, Gaussians, RenderOptions, make_rasterization
from ssa_nerfstudio.rasterization.tile_lists import tile_lists


class Projected(NamedTuple):
    """What blending needs of N Gaussians in C cameras."""

    means2d: Tensor  # [C, N, 2], pixels
    conics: Tensor  # [C, N, 3]
    alphas: Tensor  # [C, N]
    depths: Tensor  # [C, N], world units
    radii: Tensor  # [C, N] int32, pixels


def project(gaussians: Gaussians, cameras: Cameras, options: RenderOptions) -> Projected:
    """Project with gsplat's kernels, all on the current stream; shapes follow from those of the arguments."""
    means, quats, scales, opacities, _ = gaussians
    viewmats, Ks, width, height, _ = cameras
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
        eps2d=options.eps2d,
        near_plane=options.near_plane,
        far_plane=options.far_plane,
        radius_clip=options.radius_clip,
        calc_compensations=options.antialiased,
    )
    alphas = opacities.expand(n_cameras, -1)
    if compensations is not None:
        alphas = alphas * compensations
    return Projected(means2d, conics, alphas.contiguous(), depths, radii)


def centers(viewmats: Tensor) -> Tensor:
    """Positions [C, 3] of cameras whose rigid world-to-camera matrices [C, 4, 4] are given."""
    # No matrix product: a recording of cuBLAS holds 32 MiB.
    return -(viewmats[:, :3, :3] * viewmats[:, :3, 3:]).sum(dim=1)


def shade(gaussians: Gaussians, projected: Projected, cameras: Cameras, options: RenderOptions) -> Tensor:
    """Channels [C, N, X] of projected Gaussians, as `render_mode` says."""
    n_cameras, colors = len(projected.radii), gaussians.colors
    if options.sh_degree is None:
        rgb = colors.expand(n_cameras, -1, -1)
    else:
        directions = gaussians.means - centers(cameras.viewmats)[:, None]
        coefficients = colors.expand(n_cameras, -1, -1, -1)
        rgb = spherical_harmonics(options.sh_degree, directions, coefficients, masks=projected.radii > 0)
        rgb = torch.clamp_min(rgb + 0.5, 0.0)
    if options.render_mode == "RGB":
        return rgb
    depths = projected.depths[..., None]
    return depths if options.render_mode in ("D", "ED") else torch.cat([rgb, depths], dim=-1)


def blend(projected: Projected, channels: Tensor, cameras: Cameras, options: RenderOptions) -> tuple[Tensor, Tensor]:
    """Blend with gsplat's kernels: render [C, H, W, X] and alpha [C, H, W, 1]. It reads the device once."""
    means2d, conics, alphas, *_ = projected
    n_cameras, width, height, backgrounds = len(means2d), cameras.width, cameras.height, cameras.backgrounds
    if options.render_mode != "RGB" and backgrounds is not None:
        backgrounds = torch.cat([backgrounds, backgrounds.new_zeros(n_cameras, 1)], dim=-1)
        backgrounds = backgrounds[:, -channels.shape[-1] :]
    image, alpha = rasterize_to_pixels(
        means2d,
        conics,
        channels,
        alphas,
        width,
        height,
        TILE,
        *tile_lists(*projected, width, height),
        backgrounds=backgrounds,
        absgrad=options.absgrad,
    )
    if options.render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp_min(1e-10)], dim=-1)
    return image, alpha


class Blending:
    """`blend` of RGB over nothing, whose gradient is taken by hand, and once.

    Calls what `rasterize_to_pixels` gives to autograd, whose thread takes the host longer than the launches (0.45 ms a
    step where a launch takes 0.02).
    """

    image: Tensor  # [C, H, W, 3]
    alpha: Tensor  # [C, H, W, 1]
    needs_input_grad = (False,) * 12  # read for a background, the fifth
    saved_tensors: tuple[Tensor | None, ...]

    def __init__(self, projected: Projected, channels: Tensor, cameras: Cameras, options: RenderOptions) -> None:
        """Blend; arguments as of `blend`, contiguous."""
        self._centers = projected.means2d
        size, absgrad = (cameras.width, cameras.height), options.absgrad
        splats = projected.means2d, projected.conics, channels, projected.alphas
        with torch.no_grad():
            lists = tile_lists(*projected, *size)
            found = _RasterizeToPixels.forward(self, *splats, *(None, None), *size, TILE, *lists, absgrad)  # pyright: ignore
        self.image, self.alpha = (each.requires_grad_() for each in found)

    def save_for_backward(self, *tensors: Tensor | None) -> None:
        """As of the context that autograd would hand over."""
        self.saved_tensors = tensors

    @torch.no_grad()
    def backpropagate(self, of_image: Tensor, of_alpha: Tensor) -> list[Tensor | None]:
        """Gradients of what was blended, given those of the picture; sets `grad` and `absgrad` of the centers.

        Returns:
            In the order of `Projected`, None for depths and radii, and of the channels.
        """
        means2d, conics, channels, alphas, *_ = _RasterizeToPixels.backward(self, of_image, of_alpha)
        self._centers.grad = means2d
        return [means2d, conics, alphas, None, None, channels]


def render(gaussians: Gaussians, cameras: Cameras, options: RenderOptions) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render with gsplat's kernels. See `interface.Render`."""
    projected = project(gaussians, cameras, options)
    channels = shade(gaussians, projected, cameras, options)
    return *blend(projected, channels, cameras, options), projected.radii, projected.means2d


rasterization = make_rasterization(render)
