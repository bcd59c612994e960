"""`projection.project` by numba kernels, for the `cpu` rasterizer."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio._system.kernel_threads import on_all_threads
from ssa_nerfstudio.rasterization import _projection_kernels as kernels
from ssa_nerfstudio.rasterization import projection
from ssa_nerfstudio.rasterization.interface import Gaussians, RenderOptions
from ssa_nerfstudio.rasterization.projection import Splats

MAX_SH_DEGREE = 3
"""The kernels evaluate spherical harmonics up to this degree."""


def project(
    gaussians: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int, options: RenderOptions
) -> Splats:
    """Project by the kernels; arguments and result of `projection.project`.

    Gradients of the camera (a camera optimizer), antialiasing and harmonics above degree 3 have no kernels and go to
    `projection.project`.
    """
    sh_degree = options.sh_degree
    if viewmat.requires_grad or K.requires_grad or options.antialiased or (sh_degree or 0) > MAX_SH_DEGREE:
        return projection.project(gaussians, viewmat, K, width, height, options)
    means, quats, scales, opacities, colors = gaussians
    n = means.shape[0]
    camera = (viewmat.detach().to(torch.float64).numpy(), K.detach().to(torch.float64).numpy(), width, height)
    arrays = [np.ascontiguousarray(t.detach().numpy()) for t in (means, quats, scales)]
    geometry = np.empty((n, 6), arrays[0].dtype)
    radii = np.empty(n, np.int32)
    limits = (options.near_plane, options.far_plane, options.radius_clip, options.eps2d)
    on_all_threads(kernels.project_gaussians, *arrays, *camera, *limits, geometry, radii)
    ids = _nearest_first(np.flatnonzero(radii), geometry[:, 5])
    places = np.full(n, -1, np.int32)
    places[ids] = np.arange(len(ids), dtype=np.int32)
    splats, shaded = _Project.apply(  # pyright: ignore[reportGeneralTypeIssues]
        means, quats, scales, colors, geometry[ids], places, arrays, camera, options.eps2d, sh_degree
    )
    ids = torch.from_numpy(ids)
    return Splats(
        ids=ids,
        radii=torch.from_numpy(radii)[ids],
        means2d=splats[:, 0:2],
        conics=splats[:, 2:5],
        opacities=opacities[ids],
        colors=torch.cat([shaded, splats[:, 5:]], dim=-1),
    )


class _Project(torch.autograd.Function):
    """The projection kernels as an autograd function: geometry [V, 6] and color [V, 3] of the drawn Gaussians."""

    @staticmethod
    def forward(ctx, means, quats, scales, colors, geometry, places, arrays, camera, eps2d, sh_degree):  # pyright: ignore
        coefficients = np.ascontiguousarray(colors.detach().numpy())
        shaded = np.empty((len(geometry), 3), geometry.dtype)
        if sh_degree is None:
            drawn = places >= 0
            shaded[places[drawn]] = coefficients[drawn]
        else:
            on_all_threads(kernels.shade, places, arrays[0], _center(camera[0]), coefficients, sh_degree, shaded)
        ctx.saved = (places, arrays, coefficients, shaded, camera, eps2d, sh_degree)
        return torch.from_numpy(geometry), torch.from_numpy(shaded)

    @staticmethod
    def backward(ctx, v_splats, v_shaded):  # pyright: ignore[reportIncompatibleMethodOverride]
        places, arrays, coefficients, shaded, camera, eps2d, sh_degree = ctx.saved
        # Not zeros_like, which writes its zeros: memory from zeros is zero when it is first touched.
        v_means, v_quats, v_scales, v_colors = (np.zeros(a.shape, a.dtype) for a in (*arrays, coefficients))
        v_geometry = v_splats.contiguous().numpy()
        on_all_threads(
            kernels.backpropagate_projection, places, *arrays, *camera, eps2d, v_geometry, v_means, v_quats, v_scales
        )
        v = v_shaded.contiguous().numpy()
        if sh_degree is None:
            drawn = places >= 0
            v_colors[drawn] = v[places[drawn]]
        else:
            on_all_threads(
                kernels.backpropagate_shading,
                places, arrays[0], _center(camera[0]), coefficients, sh_degree, shaded, v, v_means, v_colors,
            )  # fmt: skip
        return *(torch.from_numpy(g) for g in (v_means, v_quats, v_scales, v_colors)), *[None] * 6


def _nearest_first(drawn: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """The indices `drawn`, ascending, in order of their depths [N], all positive; ties stay in order of the index."""
    if depths.dtype != np.float32:
        return drawn[np.argsort(depths[drawn], kind="stable")]
    # Positive floats sort as their bits do: one sort of integers, several times faster than a stable argsort.
    keys = depths[drawn].view(np.int32).astype(np.int64) << 32 | drawn
    keys.sort()
    return keys & 0xFFFFFFFF


def _center(viewmat: np.ndarray) -> np.ndarray:
    """World position [3] of the camera of a rigid world-to-camera matrix [4, 4]."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]
