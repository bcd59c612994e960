"""Projection of Gaussians to splats on the image, with view-dependent color and culling, in differentiable torch.

The mathematics is gsplat's own `_torch_impl`. Gaussians behind the near plane are culled *before* the projection: the
perspective division of one at the camera center yields infinities whose gradients are NaN, and culled Gaussians should
cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics
from torch import Tensor

from ssa_nerfstudio.rasterization.interface import Gaussians, RenderOptions


@dataclass
class Splats:
    """The V of N Gaussians that touch one camera's image, nearest first."""

    ids: Tensor  # [V] int64, index into the N Gaussians, in order of depth (ties: of index)
    radii: Tensor  # [V] int32, half the side of the three-sigma square in pixels, at least 1
    means2d: Tensor  # [V, 2], pixels
    conics: Tensor  # [V, 3], upper triangle (xx, xy, yy) of the inverse covariance, 1 / square pixels
    opacities: Tensor  # [V], after the compensation of the antialiased mode
    colors: Tensor  # [V, 4], red, green, blue (not clamped above) and depth in world units


Project = Callable[[Gaussians, Tensor, Tensor, int, int, RenderOptions], Splats]
"""The signature of `project`."""


def project(
    gaussians: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int, options: RenderOptions
) -> Splats:
    """Project the Gaussians that one pinhole camera sees.

    Args:
        gaussians: the Gaussians in world space.
        viewmat: world to camera [4, 4], rigid.
        K: intrinsics [3, 3], pixels.
        width, height: of the image, pixels.
        options: clipping planes, radius_clip, eps2d, sh_degree and antialiased apply.

    Returns:
        The visible splats in order of depth.
    """
    means, quats, scales, opacities, colors = gaussians
    with torch.no_grad():
        depths = means @ viewmat[2, :3] + viewmat[2, 3]
        in_front = torch.nonzero((depths > options.near_plane) & (depths < options.far_plane)).squeeze(-1)
    near = _Selection(in_front, means.shape[0])
    means, quats, scales = near(means), near(quats), near(scales)
    covars, _ = _quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, compensations = _fully_fused_projection(
        means,
        covars,  # pyright: ignore[reportArgumentType]
        viewmat[None],
        K[None],
        width,
        height,
        eps2d=options.eps2d,
        near_plane=options.near_plane,
        far_plane=options.far_plane,
        calc_compensations=options.antialiased,
    )
    with torch.no_grad():
        drawn = torch.nonzero(radii[0] > options.radius_clip).squeeze(-1)
        order = drawn[torch.sort(depths[0, drawn], stable=True).indices]
    ids = in_front[order]
    alphas = opacities[ids]
    if compensations is not None:
        alphas = alphas * compensations[0, order]
    depth = depths[0, order]
    if options.sh_degree is None:
        rgb = colors[ids]
    else:
        directions = means[order] - _camera_center(viewmat)
        bases = (options.sh_degree + 1) ** 2
        rgb = _spherical_harmonics(options.sh_degree, directions, colors[:, :bases][ids])
        rgb = torch.clamp_min(rgb + 0.5, 0.0)
    return Splats(
        ids=ids,
        radii=radii[0, order],
        means2d=means2d[0, order],
        conics=conics[0, order],
        opacities=alphas,
        colors=torch.cat([rgb, depth[:, None]], dim=-1),
    )


class _Selection:
    """Index along the first dimension; no copy where everything is selected."""

    def __init__(self, ids: Tensor, total: int) -> None:
        self.ids = ids
        self.everything = ids.numel() == total

    def __call__(self, values: Tensor) -> Tensor:
        return values if self.everything else values[self.ids]


def _camera_center(viewmat: Tensor) -> Tensor:
    """World position [3] of the camera of a rigid world-to-camera matrix [4, 4]."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]
