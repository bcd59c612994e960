"""The loss terms: photometric (L1 and SSIM) and sparsity of the matte. Pure functions; all are means over pixels."""

from __future__ import annotations

import importlib.util
import math
from functools import lru_cache, reduce
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

Sparsity = Literal["l1", "log", "off"]
SSIMBody = Literal["fused", "convolution", "shifted-sums"]
"""How the SSIM term is computed: in kernels together with its gradient, or in torch, as convolutions or as 11 shifted
and weighted copies a direction (which torch.compile can fuse). The values are the same within rounding."""

LOG_SOFTNESS = 0.1
"""e of the concave penalty log(1 + A / e): below this opacity it acts like l1, above it spares what is opaque."""
LOG_EVIDENCE_FLOOR = 0.1
"""Share of the concave penalty that a pixel pays whose color is the same in all views."""
SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window in pixels (sigma 1.5); "valid" padding, as pytorch_msssim."""


def photometric(prediction: Tensor, target: Tensor, ssim_weight: float, body: SSIMBody = "fused") -> Tensor:
    """(1 - w) mean |prediction - target| + w (1 - SSIM) (paper, equation of L_rgb; w = 0.2).

    Where a kernel exists (numba on the CPU, Triton on CUDA), value and gradient come from the same two passes over the
    image; elsewhere from `ssim` and autograd. Images of less than 11 pixels a side have no window for SSIM and are
    compared by L1 alone.

    Args:
        prediction, target: [H, W, 3] in [0, 1]; only the prediction receives a gradient.
        ssim_weight: w in [0, 1]; at 0 SSIM is not computed.
        body: other than `fused`, always plain torch and autograd.
    """
    if ssim_weight == 0 or min(prediction.shape[:2]) < SSIM_WINDOW:
        return (prediction - target).abs().mean()
    if body != "fused":
        return photometric_reference(prediction, target, ssim_weight, body)
    return _Photometric.apply(prediction, target, ssim_weight)  # pyright: ignore[reportReturnType]


def photometric_reference(
    prediction: Tensor, target: Tensor, ssim_weight: float, body: SSIMBody = "convolution"
) -> Tensor:
    """`photometric` in plain torch, differentiable in both images: the oracle of the kernels."""
    l1 = (prediction - target).abs().mean()
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim(prediction, target, body))


def ssim(prediction: Tensor, target: Tensor, body: SSIMBody = "convolution") -> Tensor:
    """Mean structural similarity over the positions where the whole 11 x 11 window fits ("valid" padding).

    K1 = 0.01, K2 = 0.03, data range 1 (Wang et al. 2004), as pytorch_msssim.

    Args:
        prediction, target: [H, W, 3] in [0, 1], at least 11 pixels a side.
        body: convolution or shifted-sums.
    """
    x, y = prediction.permute(2, 0, 1), target.permute(2, 0, 1)
    moments = torch.cat([x, y, x * x + y * y, x * y])[None]
    if body == "shifted-sums":
        means = _shifted_sum(_shifted_sum(moments, dim=3), dim=2)
    else:
        window = torch.tensor(gaussian_window(), dtype=x.dtype, device=x.device).expand(moments.shape[1], 1, 1, -1)
        rows = F.conv2d(moments, window, groups=moments.shape[1])
        means = F.conv2d(rows, window.mT, groups=moments.shape[1])
    mean_x, mean_y, squares, product = means[0].chunk(4)
    mean_product = mean_x * mean_y
    mean_squares = mean_x * mean_x + mean_y * mean_y
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2.0 * mean_product + c1) / (mean_squares + c1)
    structure = (2.0 * (product - mean_product) + c2) / (squares - mean_squares + c2)
    return (luminance * structure).mean()


def sparsity(matte: Tensor, evidence: Tensor, kind: Sparsity) -> Tensor:
    """How much artifact there is: what keeps scene and exposure out of the overlay.

    `l1` is the paper's mean_u A(u). `log` is mean_u (0.1 + 0.9 r(u)) log(1 + A / e) / log(1 + 1 / e) with e = 0.1: it
    presses on a faint, wide matte (an exposure layer), and spares opaque ones and pixels whose views agree.

    Args:
        matte: A [h, w, 1] in [0, 1].
        evidence: r [h, w, 1] in [0, 1], small where the views agree (`ScreenSpaceOverlay.evidence`).
        kind: `off` is zero.

    Returns:
        A scalar in [0, 1].
    """
    if kind == "off":
        return matte.new_zeros(())
    if kind == "l1":
        return matte.mean()
    return _LogSparsity.apply(matte, evidence)  # pyright: ignore[reportReturnType]


def gaussian_window() -> tuple[float, ...]:
    """SSIM's window along one dimension: 11 weights of a Gaussian with sigma 1.5, summing to 1."""
    values = [math.exp(-((i - SSIM_WINDOW // 2) ** 2) / (2 * 1.5**2)) for i in range(SSIM_WINDOW)]
    return tuple(v / sum(values) for v in values)


def _shifted_sum(values: Tensor, dim: int) -> Tensor:
    """The window's weighted mean along one dimension, at the positions where it fits."""
    length = values.shape[dim] - SSIM_WINDOW + 1
    shifted = (weight * values.narrow(dim, k, length) for k, weight in enumerate(gaussian_window()))
    return reduce(torch.add, shifted)


class _LogSparsity(torch.autograd.Function):
    """mean (f + (1 - f) r) log(1 + A / e) / log(1 + 1 / e); by hand, in nine kernels instead of fourteen."""

    @staticmethod
    def forward(ctx, matte: Tensor, evidence: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        weight = torch.rsub(evidence, LOG_EVIDENCE_FLOOR, alpha=LOG_EVIDENCE_FLOOR - 1.0)
        ctx.save_for_backward(matte, weight)
        penalty = torch.special.xlog1py(weight, matte * (1.0 / LOG_SOFTNESS))
        return penalty.mean() * (1.0 / math.log1p(1.0 / LOG_SOFTNESS))

    @staticmethod
    @once_differentiable
    def backward(ctx, v: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        matte, weight = ctx.saved_tensors
        scale = v * (1.0 / (matte.numel() * math.log1p(1.0 / LOG_SOFTNESS)))
        return scale * (weight / (matte + LOG_SOFTNESS)), None


class _Photometric(torch.autograd.Function):
    """The loss as one operation whose gradient is computed together with its value."""

    @staticmethod
    def forward(ctx, prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:  # pyright: ignore
        x, y = prediction.detach(), target.detach().to(prediction.dtype)
        if x.is_cuda and _triton_available():
            from ssa_nerfstudio.overlay._kernels.photometric_triton import value_and_gradient

            value, gradient = value_and_gradient(x, y, ssim_weight, gaussian_window())
        elif x.device.type == "cpu":
            from ssa_nerfstudio.overlay._kernels.photometric_numba import value_and_gradient

            x_planes, y_planes = (image.permute(2, 0, 1).contiguous().numpy() for image in (x, y))
            window = np.array(gaussian_window(), x_planes.dtype)
            number, planes = value_and_gradient(x_planes, y_planes, ssim_weight, window)
            value, gradient = x.new_tensor(number), torch.from_numpy(planes).permute(1, 2, 0)
        else:
            with torch.enable_grad():
                x = x.requires_grad_()
                value = photometric_reference(x, y, ssim_weight)
                (gradient,) = torch.autograd.grad(value, x)
        ctx.save_for_backward(gradient)
        return value.detach()

    @staticmethod
    def backward(ctx, v: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = ctx.saved_tensors
        return v * gradient, None, None


@lru_cache(maxsize=1)
def _triton_available() -> bool:
    return importlib.util.find_spec("triton") is not None
