"""The signature that every rasterizer here has: gsplat's `rasterization`, around a function that blends splats."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from ssa_nerfstudio.rasterization import constants
from ssa_nerfstudio.rasterization.projection import Splats, project

Blend = Callable[[Splats, Tensor, int, int, int, bool], tuple[Tensor, Tensor]]
"""`blend(splats, means2d, camera, width, height, absgrad)` returns color and depth [H, W, 4] and alpha [H, W, 1].

`means2d` [C, N, 2] holds the splats' centers at `means2d[camera, splats.ids]`; gradients of the centers go through it,
because densification reads them there (and, where `absgrad`, their sum of magnitudes as `means2d.absgrad`).
"""


def rasterization_with(
    blend: Blend, project: Callable[..., Splats] = project
) -> Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]:
    """Make a `rasterization` function out of a blending and a projecting function (`projection.project`)."""

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
        """Draw N Gaussians into C pinhole cameras: `gsplat.rasterization` with three color channels.

        Args:
            means, quats, scales, opacities: the Gaussians: world units; w x y z; standard deviations; [0, 1].
            colors: final RGB [N, 3], or spherical harmonics [N, K, 3] where `sh_degree` is given.
            viewmats, Ks: world to camera (OpenCV axes), intrinsics in pixels.
            backgrounds: color behind the splats; black where None.
            render_mode: D is alpha-weighted depth, ED the expected depth, along the view axis in world units.
            absgrad: leave the summed magnitudes of the centers' gradients in `info["means2d"].absgrad`.

        Returns:
            render [C, H, W, X] with X channels by `render_mode`, alpha [C, H, W, 1], and `info` with what
            gsplat's densification strategies read: `radii` [C, N] int32, `means2d` [C, N, 2], `width`, `height`,
            `n_cameras`, `gaussian_ids` and `camera_ids` (None: not packed), `tile_size`.

        Raises:
            ValueError: for what only the CUDA body can do (packed, sparse gradients, another tile size).
        """
        if packed or sparse_grad or tile_size != constants.TILE:
            raise ValueError("packed, sparse_grad and tile_size other than 16 exist on CUDA only; leave them out")
        if colors.shape[-1] != 3 or colors.dim() != (2 if sh_degree is None else 3):
            raise ValueError(
                f"colors have shape {tuple(colors.shape)}; give [N, 3], or [N, K, 3] together with sh_degree"
            )
        n_cameras, n_gaussians = viewmats.shape[0], means.shape[0]
        views = [
            project(
                means,
                quats,
                scales,
                opacities,
                colors,
                viewmats[camera],
                Ks[camera],
                width,
                height,
                near_plane=near_plane,
                far_plane=far_plane,
                radius_clip=radius_clip,
                eps2d=eps2d,
                sh_degree=sh_degree,
                antialiased=rasterize_mode == "antialiased",
            )
            for camera in range(n_cameras)
        ]
        means2d = torch.stack([means.new_zeros(n_gaussians, 2).index_copy(0, v.ids, v.means2d) for v in views])
        radii = torch.zeros(n_cameras, n_gaussians, dtype=torch.int32, device=means.device)
        for camera, view in enumerate(views):
            radii[camera, view.ids] = view.radii
        blended = [blend(view, means2d, camera, width, height, absgrad) for camera, view in enumerate(views)]
        drawn = torch.stack([image for image, _ in blended])
        alpha = torch.stack([a for _, a in blended])

        rgb, depth = drawn[..., :3], drawn[..., 3:]
        if backgrounds is not None:
            rgb = rgb + (1.0 - alpha) * backgrounds[:, None, None, :]
        if render_mode.endswith("ED"):
            depth = depth / alpha.clamp_min(1e-10)
        channels = {"RGB": [rgb], "D": [depth], "ED": [depth]}.get(render_mode, [rgb, depth])
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
        return (channels[0] if len(channels) == 1 else torch.cat(channels, dim=-1)), alpha, info

    return rasterization
