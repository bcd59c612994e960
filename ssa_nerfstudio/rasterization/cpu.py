"""The rasterizer for CPUs: numba kernels with a hand-written backward pass, deterministic for any number of threads."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio._system.kernel_threads import on_all_threads
from ssa_nerfstudio.rasterization import _blending_kernels as kernels
from ssa_nerfstudio.rasterization import _splat_lists as lists
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
        conics, opacities, colors = (np.ascontiguousarray(t.detach().numpy()) for t in (conics, opacities, colors))
        shapes = np.empty((len(centers), lists.SHAPE), np.float64)
        bounds = np.empty((len(centers), 4), np.int32)
        on_all_threads(lists.shape_splats, centers, conics, opacities, radii.numpy(), width, height, shapes, bounds)
        starts, members, slots = lists.assign_bands(bounds, -(-height // TILE))
        image = np.empty((height, width, 4), centers.dtype)
        transmittance = np.empty((height, width), centers.dtype)
        last = np.empty((height, width), np.int32)
        splats = (shapes, bounds)
        scratch = np.empty((torch.get_num_threads(), kernels.scratch_size(width)), centers.dtype)
        on_all_threads(kernels.blend_bands, starts, members, *splats, colors, scratch, image, transmittance, last)
        ctx.save_for_backward(means2d, ids)
        ctx.blended = (starts, members, slots, *splats, conics, colors, transmittance, last)
        ctx.camera, ctx.absgrad = camera, absgrad
        return torch.from_numpy(image), torch.from_numpy(1 - transmittance[..., None])

    @staticmethod
    def backward(ctx, v_image, v_alpha):  # pyright: ignore[reportIncompatibleMethodOverride]
        means2d, ids = ctx.saved_tensors
        members, slots, conics = ctx.blended[1], ctx.blended[2], ctx.blended[5]
        partial = np.zeros((len(members), kernels.GRADIENTS), np.float64)
        scratch = np.empty((torch.get_num_threads(), kernels.scratch_size(v_image.shape[1])), conics.dtype)
        v_pixels = (v_image.contiguous().numpy(), v_alpha[..., 0].contiguous().numpy())
        on_all_threads(kernels.backpropagate_bands, *ctx.blended, *v_pixels, scratch, partial)
        total = np.empty((len(conics), kernels.GRADIENTS), conics.dtype)
        kernels.sum_partials(slots, partial, total)
        v = torch.from_numpy(total)
        v_means2d = torch.zeros_like(means2d)
        v_means2d[ctx.camera, ids] = v[:, 0:2]
        if ctx.absgrad:
            # As gsplat's DefaultStrategy expects it; each camera fills its own rows.
            if not hasattr(means2d, "absgrad"):
                means2d.absgrad = torch.zeros_like(means2d)
            means2d.absgrad[ctx.camera, ids] = v[:, 2:4]
        return v_means2d, v[:, 4:7], v[:, 7], v[:, 8:12], None, None, None, None, None, None
