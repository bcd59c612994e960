"""From Gaussians in the world to splats on the image: projection, view-dependent color, culling. Differentiable torch.

The mathematics is gsplat's own `_torch_impl`, called and not copied. Gaussians in front of the near plane are selected
*before* projecting: the perspective division of one at the camera center yields infinities whose gradients are NaN,
and culled Gaussians should cost nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics
from torch import Tensor


@dataclass
class Splats:
    """The Gaussians of one camera that touch its image, nearest first. V of the N Gaussians are left."""

    ids: Tensor  # [V] int64, index into the N Gaussians, in order of depth (ties: of index)
    radii: Tensor  # [V] int32, half the side of the three-sigma square in pixels, at least 1
    means2d: Tensor  # [V, 2], pixels
    conics: Tensor  # [V, 3], upper triangle (xx, xy, yy) of the inverse covariance, 1 / square pixels
    opacities: Tensor  # [V], after the compensation of the antialiased mode
    colors: Tensor  # [V, 4], red, green, blue (not clamped above) and depth in world units


def project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4], w x y z, not necessarily normalized
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, 3] or [N, K, 3]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    *,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    sh_degree: int | None,
    antialiased: bool,
) -> Splats:
    """Project the Gaussians that one pinhole camera sees.

    Args:
        sh_degree: None where `colors` are final [N, 3]; else the degree up to which the coefficients
            [N, K, 3] are evaluated, (sh_degree + 1)^2 <= K.
        radius_clip: splats with a radius of at most this many pixels are dropped.
        antialiased: scale the opacities by sqrt(det / det with eps2d), as gsplat's "antialiased" mode does.

    Returns:
        The visible splats in order of depth.
    """
    with torch.no_grad():
        depths = means @ viewmat[2, :3] + viewmat[2, 3]
        in_front = torch.nonzero((depths > near_plane) & (depths < far_plane)).squeeze(-1)
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
        eps2d=eps2d,
        near_plane=near_plane,
        far_plane=far_plane,
        calc_compensations=antialiased,
    )
    with torch.no_grad():
        drawn = torch.nonzero(radii[0] > radius_clip).squeeze(-1)
        order = drawn[torch.sort(depths[0, drawn], stable=True).indices]
    ids = in_front[order]
    alphas = opacities[ids]
    if compensations is not None:
        alphas = alphas * compensations[0, order]
    depth = depths[0, order]
    if sh_degree is None:
        rgb = colors[ids]
    else:
        directions = means[order] - _camera_center(viewmat)
        bases = (sh_degree + 1) ** 2
        rgb = _spherical_harmonics(sh_degree, directions, colors[:, :bases][ids])
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
    """Index the first dimension, without a copy where everything is selected."""

    def __init__(self, ids: Tensor, total: int) -> None:
        self.ids = ids
        self.everything = ids.numel() == total

    def __call__(self, values: Tensor) -> Tensor:
        return values if self.everything else values[self.ids]


def _camera_center(viewmat: Tensor) -> Tensor:
    """World position [3] of the camera of a rigid world-to-camera matrix [4, 4]."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]
