"""The photometric loss: L1 and SSIM between a prediction and a photo. A mean over pixels.

Kernels compute value and gradient together, numba on a CPU and Triton on CUDA. `photometric_reference` is their
plain-torch twin: tests compare the kernels with it, and CUDA without Triton falls back to it.
"""

from __future__ import annotations

import importlib.util
import logging
import math
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window, pixels."""
SSIM_SIGMA = 1.5
"""Standard deviation of SSIM's Gaussian window, pixels."""

_LOG = logging.getLogger(__name__)


def photometric_loss(prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """(1 - w) mean |prediction - target| + w (1 - SSIM) (paper, equation of L_rgb; w = 0.2).

    Images of less than 11 pixels a side hold no SSIM window and are compared by L1 alone.

    Args:
        prediction, target: [H, W, 3] in [0, 1]; only the prediction receives a gradient.
        ssim_weight: w in [0, 1]; at 0 SSIM is not computed.

    Returns:
        A scalar; not finite where a pixel of either image is not finite.
    """
    if ssim_weight == 0 or min(prediction.shape[:2]) < SSIM_WINDOW:
        return (prediction - target).abs().mean()
    return _Photometric.apply(prediction, target, ssim_weight)  # pyright: ignore[reportReturnType]


def photometric_reference(prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """`photometric_loss` in plain torch: any device and float dtype, differentiable in both images.

    Args:
        prediction, target: [H, W, 3] in [0, 1], at least 11 pixels a side.
        ssim_weight: w in [0, 1].
    """
    l1 = (prediction - target).abs().mean()
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim(prediction, target))


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity over the positions where the whole window fits ("valid" padding).

    K1 = 0.01, K2 = 0.03, data range 1 (Wang et al. 2004), as pytorch_msssim.

    Args:
        prediction, target: [H, W, 3] in [0, 1], at least 11 pixels a side.

    Returns:
        A scalar in [-1, 1].
    """
    x, y = prediction.permute(2, 0, 1), target.permute(2, 0, 1)
    moments = torch.cat([x, y, x * x + y * y, x * y])[None]
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


def gaussian_window() -> tuple[float, ...]:
    """SSIM's window along one dimension: SSIM_WINDOW weights that sum to 1."""
    values = [math.exp(-((i - SSIM_WINDOW // 2) ** 2) / (2 * SSIM_SIGMA**2)) for i in range(SSIM_WINDOW)]
    return tuple(v / sum(values) for v in values)


class _Photometric(torch.autograd.Function):
    """The loss as one operation whose gradient is computed together with its value."""

    @staticmethod
    def forward(ctx, prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:  # pyright: ignore
        x, y = prediction.detach(), target.detach().to(prediction.dtype)
        if x.device.type == "cpu":
            from ssa_nerfstudio.overlay._kernels.photometric_numba import value_and_gradient

            x_planes, y_planes = (image.permute(2, 0, 1).contiguous().numpy() for image in (x, y))
            window = np.array(gaussian_window(), x_planes.dtype)
            number, planes = value_and_gradient(x_planes, y_planes, ssim_weight, window)
            value, gradient = x.new_tensor(number), torch.from_numpy(planes).permute(1, 2, 0)
        elif x.is_cuda and _triton_available():
            from ssa_nerfstudio.overlay._kernels.photometric_triton import value_and_gradient

            value, gradient = value_and_gradient(x, y, ssim_weight, gaussian_window())
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
    """Whether Triton is installed; warns once where it is not."""
    available = importlib.util.find_spec("triton") is not None
    if not available:
        _LOG.warning("Triton is not installed: the photometric loss runs in plain torch, which is slower")
    return available
