"""Image metrics between a render and a photo: pure functions on torch images."""

from __future__ import annotations

import math

import numpy as np
import torch
from pytorch_msssim import ssim as windowed_ssim
from torch import Tensor

from ssa_nerfstudio.metrics.flip import flip_error

SSIM_WINDOW = 11
"""Side of the Gaussian window of `ssim`, in pixels."""
SSIM_SIGMA = 1.5
"""Standard deviation of the Gaussian window of `ssim`, in pixels."""
RANGE_TOLERANCE = 1e-6
"""Values this far outside [0, 1] are taken for rounding and clipped."""


def psnr(render: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio, 10 log10(1 / mean squared error) over pixels and channels.

    Args:
        render: image [H, W, 3], floating point, in [0, 1].
        target: image of the same shape and range.

    Returns:
        Decibels; `inf` where the images are equal.

    Raises:
        ValueError: an image is not a finite floating-point [H, W, 3] in [0, 1], or the shapes differ.
    """
    render, target = _image_pair(render, target)
    mean_squared_error = (render - target).square().mean().item()
    return math.inf if mean_squared_error == 0 else -10 * math.log10(mean_squared_error)


def ssim(render: Tensor, target: Tensor) -> float:
    """Structural similarity with an 11 x 11 Gaussian window of sigma 1.5 and "valid" padding.

    Only windows inside the image count, so the outer 5 pixels are never a window's center. torchmetrics, and with it
    splatfacto's `ns-eval`, pads by reflection; its values differ slightly. Mean over channels and windows. Wang et al.
    2004, "Image quality assessment: from error visibility to structural similarity", with K1 = 0.01 and K2 = 0.03.

    Args:
        render: image [H, W, 3], floating point, in [0, 1], both sides at least 11 pixels.
        target: image of the same shape and range.

    Returns:
        A number in [-1, 1]; 1 where the images are equal.

    Raises:
        ValueError: as `psnr`, or a side is shorter than the window.
    """
    render, target = _image_pair(render, target)
    if min(render.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs images of at least {SSIM_WINDOW} x {SSIM_WINDOW}, got {tuple(render.shape)}")
    # The library's own window has single precision and sums to 1 only within 1e-7, which shows in flat regions.
    offsets = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    window = torch.softmax(-offsets.square() / (2 * SSIM_SIGMA**2), dim=0).expand(3, 1, 1, -1)
    return windowed_ssim(
        render.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], data_range=1.0, win=window
    ).item()


def flip(render: Tensor, target: Tensor) -> float:
    """Mean FLIP error: the difference a viewer sees when alternating between the two images.

    Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images", LDR (sRGB) at 67 pixels per degree.

    Args:
        render: the image under test, [H, W, 3], floating point, sRGB in [0, 1].
        target: the reference, same shape and range.

    Returns:
        A number in [0, 1]; 0 where the images are equal.

    Raises:
        ValueError: as `psnr`.
    """
    return flip_error(*flip_arrays(render, target))


def flip_arrays(render: Tensor, target: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Convert two images to the arguments of `flip_error`.

    Args:
        render, target: as for `flip`.

    Returns:
        Reference and test, float32 [H, W, 3], contiguous.

    Raises:
        ValueError: as `psnr`.
    """
    render, target = _image_pair(render, target)
    reference, test = (np.ascontiguousarray(image.float().cpu().numpy()) for image in (target, render))
    return reference, test


def mean_color_deviation(render: Tensor, target: Tensor) -> float:
    """Distance between the two images' mean colors, the paper's Delta c-bar.

    The 2-norm of the difference of mean RGB on the 0..255 scale. It reveals a near-uniform tint or exposure shift that
    hardly changes PSNR or SSIM.

    Args:
        render: image [H, W, 3], floating point, in [0, 1].
        target: image of the same shape and range.

    Returns:
        A number in [0, 255 sqrt(3)].

    Raises:
        ValueError: as `psnr`.
    """
    render, target = _image_pair(render, target)
    return 255 * torch.linalg.vector_norm((render - target).mean(dim=(0, 1))).item()


def _image_pair(render: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    render, target = checked_unit_range(render, "render", 3), checked_unit_range(target, "target", 3)
    if render.shape != target.shape:
        raise ValueError(f"render {tuple(render.shape)} and target {tuple(target.shape)} differ in shape")
    return render, target.to(render.device)


def checked_unit_range(image: Tensor, name: str, dimensions: int) -> Tensor:
    """Check an image or a matte and convert it to float64, clipped to [0, 1].

    Double precision because single-precision convolutions run as TF32 on recent GPUs and the variance inside SSIM is a
    difference of close numbers.

    Args:
        image: [H, W, 3] or [H, W], floating point.
        name: of the argument, for messages.
        dimensions: 3 for [H, W, 3], 2 for [H, W].

    Raises:
        ValueError: another shape or dtype, values that are not finite, or values outside [0, 1].
    """
    expected = "[H, W, 3]" if dimensions == 3 else "[H, W]"
    if image.ndim != dimensions or (dimensions == 3 and image.shape[2] != 3) or image.numel() == 0:
        raise ValueError(f"{name} must be a non-empty {expected}, got {tuple(image.shape)}")
    if not image.is_floating_point():
        raise ValueError(f"{name} must be floating point in [0, 1], got {image.dtype}")
    image = image.detach().double()
    if not torch.isfinite(image).all():
        raise ValueError(f"{name} holds NaN or infinity")
    low, high = image.min().item(), image.max().item()
    if low < -RANGE_TOLERANCE or high > 1 + RANGE_TOLERANCE:
        raise ValueError(f"{name} must be in [0, 1], got values in [{low:g}, {high:g}]")
    return image.clamp(0, 1)
