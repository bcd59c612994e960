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
    drawn = np.flatnonzero(radii)
    ids = torch.from_numpy(drawn[np.argsort(geometry[drawn, 5], kind="stable")])
    splats, shaded = _Project.apply(  # pyright: ignore[reportGeneralTypeIssues]
        means, quats, scales, colors, ids, geometry, arrays, camera, options.eps2d, sh_degree
    )
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
    def forward(ctx, means, quats, scales, colors, ids, geometry, arrays, camera, eps2d, sh_degree):  # pyright: ignore
        coefficients = np.ascontiguousarray(colors.detach().numpy())
        if sh_degree is None:
            shaded = coefficients[ids.numpy()]
        else:
            shaded = np.empty((len(ids), 3), geometry.dtype)
            on_all_threads(kernels.shade, ids.numpy(), arrays[0], _center(camera[0]), coefficients, sh_degree, shaded)
        ctx.saved = (ids, arrays, coefficients, shaded, camera, eps2d, sh_degree)
        return torch.from_numpy(geometry[ids.numpy()]), torch.from_numpy(shaded)

    @staticmethod
    def backward(ctx, v_splats, v_shaded):  # pyright: ignore[reportIncompatibleMethodOverride]
        ids, arrays, coefficients, shaded, camera, eps2d, sh_degree = ctx.saved
        numbers = ids.numpy()
        v_means, v_quats, v_scales = (np.zeros_like(array) for array in arrays)
        v_colors = np.zeros_like(coefficients)
        v_geometry = v_splats.contiguous().numpy()
        on_all_threads(
            kernels.backpropagate_projection, numbers, *arrays, *camera, eps2d, v_geometry, v_means, v_quats, v_scales
        )
        v = v_shaded.contiguous().numpy()
        if sh_degree is None:
            v_colors[numbers] = v
        else:
            on_all_threads(
                kernels.backpropagate_shading,
                numbers, arrays[0], _center(camera[0]), coefficients, sh_degree, shaded, v, v_means, v_colors,
            )  # fmt: skip
        return *(torch.from_numpy(g) for g in (v_means, v_quats, v_scales, v_colors)), *[None] * 6


def _center(viewmat: np.ndarray) -> np.ndarray:
    """World position [3] of the camera of a rigid world-to-camera matrix [4, 4]."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]
