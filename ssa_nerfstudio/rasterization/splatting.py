"""Rendering by projecting each camera's Gaussians and blending them: what the implementations without CUDA share."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ssa_nerfstudio.rasterization.interface import Cameras, Gaussians, Render, RenderOptions
from ssa_nerfstudio.rasterization.projection import Project, Splats

Blend = Callable[[Splats, Tensor, int, int, int, bool], tuple[Tensor, Tensor]]
"""`blend(splats, means2d, camera, width, height, absgrad)` returns color and depth [H, W, 4] and alpha [H, W, 1].

`means2d` [C, N, 2] holds the splats' centers at `means2d[camera, splats.ids]`; gradients of the centers, and
`means2d.absgrad`, are those of `interface.Render`.
"""


def project_and_blend(project: Project, blend: Blend) -> Render:
    """Make a `Render` of a projecting and a blending function."""

    def render(gaussians: Gaussians, cameras: Cameras, options: RenderOptions) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        means, (width, height) = gaussians.means, (cameras.width, cameras.height)
        n_cameras, n_gaussians = cameras.viewmats.shape[0], means.shape[0]
        views = [
            project(gaussians, viewmat, K, width, height, options)
            for viewmat, K in zip(cameras.viewmats, cameras.Ks, strict=True)
        ]
        means2d = torch.stack([means.new_zeros(n_gaussians, 2).index_copy(0, v.ids, v.means2d) for v in views])
        radii = torch.zeros(n_cameras, n_gaussians, dtype=torch.int32, device=means.device)
        for camera, view in enumerate(views):
            radii[camera, view.ids] = view.radii
        blended = [blend(view, means2d, camera, width, height, options.absgrad) for camera, view in enumerate(views)]
        drawn = torch.stack([image for image, _ in blended])
        alpha = torch.stack([a for _, a in blended])
        rgb, depth = drawn[..., :3], drawn[..., 3:]
        if cameras.backgrounds is not None:
            rgb = rgb + (1.0 - alpha) * cameras.backgrounds[:, None, None, :]
        if options.render_mode.endswith("ED"):
            depth = depth / alpha.clamp_min(1e-10)
        channels = {"RGB": [rgb], "D": [depth], "ED": [depth]}.get(options.render_mode, [rgb, depth])
        image = channels[0] if len(channels) == 1 else torch.cat(channels, dim=-1)
        return image, alpha, radii, means2d

    return render
