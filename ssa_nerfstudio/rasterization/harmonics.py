"""View-dependent colors from spherical harmonics, whose coefficients stay where splatfacto keeps them."""

from __future__ import annotations

import importlib.util
from typing import Any

import torch
from gsplat import spherical_harmonics
from torch import Tensor
from torch.autograd.function import once_differentiable

_TRITON = importlib.util.find_spec("triton") is not None
_HIGHEST = 3
"""Degree up to which Triton's kernels know the bases."""


def shade(means: Tensor, center: Tensor, constant: Tensor, rest: Tensor, radii: Tensor, degree: int) -> Tensor:
    """Colors [N, 3] of N Gaussians as a camera sees them: max(0, sum_k b_k c_k + 0.5).

    On CUDA one kernel, on the current stream, and one for the gradient; without Triton, and above degree 3, gsplat's,
    which are launched on the default stream (cuda/csrc/compute_sh_fwd.cu:60), so that a CUDA graph cannot hold them.

    Args:
        means: [N, 3].
        center: of the camera [3], in the means' space.
        constant, rest: coefficients [N, 3] of the first basis function, [N, K, 3] of the others.
        radii: [N] int32; where it is 0 nothing is drawn, and the color says nothing.
        degree: of the bases that count, (degree + 1)^2 <= K + 1.
    """
    if runs_on_current_stream(means.device, degree):
        return _Shaded.apply(means, center, constant, rest, radii, degree)  # pyright: ignore[reportReturnType]
    coefficients = torch.cat([constant[:, None], rest], dim=1)
    colors = spherical_harmonics(degree, means - center, coefficients, masks=radii > 0)
    return torch.clamp_min(colors + 0.5, 0.0)


def runs_on_current_stream(device: torch.device, degree: int) -> bool:
    """Whether `shade` launches its kernels on the current stream."""
    return _TRITON and device.type == "cuda" and degree <= _HIGHEST


class _Shaded(torch.autograd.Function):
    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx, means: Tensor, center: Tensor, constant: Tensor, rest: Tensor, radii: Tensor, degree: int
    ) -> Tensor:
        from ssa_nerfstudio.rasterization._harmonics_triton import colors_of

        means, center, constant, rest, radii = (each.contiguous() for each in (means, center, constant, rest, radii))
        colors = colors_of(means, center, constant, rest, radii, degree)
        ctx.save_for_backward(means, center, rest, radii, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, slopes: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        from ssa_nerfstudio.rasterization._harmonics_triton import gradients_of

        means, center, rest, radii, colors = ctx.saved_tensors
        slopes = slopes.contiguous()
        of_means, of_constant, of_rest = gradients_of(means, center, rest, radii, colors, slopes, ctx.degree)
        of_center = -of_means.sum(dim=0) if ctx.needs_input_grad[1] else None
        return of_means, of_center, of_constant, of_rest, None, None
