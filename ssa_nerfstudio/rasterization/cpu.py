"""The rasterizer for CPUs: numba kernels with a hand-written backward pass, deterministic for any number of threads."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio._system.kernel_threads import on_all_threads
from ssa_nerfstudio.rasterization import _blending_kernels as _kernels
from ssa_nerfstudio.rasterization.constants import TILE
from ssa_nerfstudio.rasterization.cpu_projection import project
from ssa_nerfstudio.rasterization.interface import make_rasterization
from ssa_nerfstudio.rasterization.projection import Splats
from ssa_nerfstudio.rasterization.splatting import project_and_blend


def blend(
    splats: Splats, means2d: Tensor, camera: int, width: int, height: int, absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Blend one camera's splats, front to back. See `splatting.Blend`; float32 or float64."""
    return _Blend.apply(
        means2d,
        splats.conics,
        splats.opacities,
        splats.colors,
        splats.ids,
        splats.radii,
        camera,
        width,
        height,
        absgrad,
    )  # pyright: ignore[reportReturnType]


rasterization = make_rasterization(project_and_blend(project, blend))


def compile_kernels() -> None:
    """Compile (or load from numba's cache) the float32 kernels, so that the first frame need not wait.

    Has to run before nerfstudio's viewer starts: it renders in a thread under `sys.settrace` that raises at arbitrary
    lines, in the middle of a compilation too.
    """
    one = torch.ones(1, 3, requires_grad=True)
    viewmat = torch.eye(4)[None]
    viewmat[0, 2, 3] = 2.0
    image, _, _ = rasterization(
        one - 1, torch.eye(4)[:1], 0.1 * one, one[:, 0], one[:, None], viewmat, torch.eye(3)[None], 1, 1,
        sh_degree=0, absgrad=True,
    )  # fmt: skip
    image.sum().backward()


class _Blend(torch.autograd.Function):
    """The blending kernels as an autograd function; centers receive gradients as the whole `means2d` [C, N, 2]."""

    @staticmethod
    def forward(ctx, means2d, conics, opacities, colors, ids, radii, camera, width, height, absgrad):  # pyright: ignore
        centers = np.ascontiguousarray(means2d.detach()[camera, ids].numpy())
        arrays = [np.ascontiguousarray(t.detach().numpy()) for t in (conics, opacities, colors)]
        bounds = _tile_bounds(centers, radii.numpy(), width, height)
        bands = _kernels.assign_bands(bounds, -(-height // TILE))
        image = np.zeros((height, width, 4), centers.dtype)
        transmittance = np.ones((height, width), centers.dtype)
        last = np.zeros((height, width), np.int32)
        starts, members, _ = bands
        on_all_threads(_kernels.blend_bands, starts, members, centers, *arrays, bounds, image, transmittance, last)
        ctx.save_for_backward(means2d, ids)
        ctx.blended = (bands, centers, arrays, bounds, transmittance, last)
        ctx.camera, ctx.absgrad = camera, absgrad
        return torch.from_numpy(image), torch.from_numpy(1 - transmittance[..., None])

    @staticmethod
    def backward(ctx, v_image, v_alpha):  # pyright: ignore[reportIncompatibleMethodOverride]
        means2d, ids = ctx.saved_tensors
        (starts, members, slots), centers, arrays, bounds, transmittance, last = ctx.blended
        partial = np.zeros((len(members), _kernels.GRADIENTS), np.float64)
        on_all_threads(
            _kernels.backpropagate_bands,
            starts,
            members,
            slots,
            centers,
            *arrays,
            bounds,
            transmittance,
            last,
            v_image.contiguous().numpy(),
            v_alpha[..., 0].contiguous().numpy(),
            partial,
        )
        total = np.empty((len(centers), _kernels.GRADIENTS), centers.dtype)
        _kernels.sum_partials(slots, partial, total)
        v = torch.from_numpy(total)
        v_means2d = torch.zeros_like(means2d)
        v_means2d[ctx.camera, ids] = v[:, 0:2]
        if ctx.absgrad:
            # As gsplat's DefaultStrategy expects it; each camera fills its own rows.
            if not hasattr(means2d, "absgrad"):
                means2d.absgrad = torch.zeros_like(means2d)
            means2d.absgrad[ctx.camera, ids] = v[:, 2:4]
        return v_means2d, v[:, 4:7], v[:, 7], v[:, 8:12], None, None, None, None, None, None


def _tile_bounds(centers: np.ndarray, radii: np.ndarray, width: int, height: int) -> np.ndarray:
    """Pixel bounds x0, x1, y0, y1 [V, 4] int32 of the tiles that each splat's three-sigma square touches."""
    size = np.array([width, height])
    tiles = -(-size // TILE)
    lower = np.clip(np.floor((centers - radii[:, None]) / TILE), 0, tiles)
    upper = np.clip(np.ceil((centers + radii[:, None]) / TILE), 0, tiles)
    bounds = np.empty((len(centers), 4), np.int32)
    bounds[:, 0::2] = lower * TILE
    bounds[:, 1::2] = np.minimum(upper * TILE, size)
    return bounds
