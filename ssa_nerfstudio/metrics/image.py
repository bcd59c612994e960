"""How close a render is to the photo, and a matte to the artifact: pure functions on torch images."""

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
"""How far outside [0, 1] a value may lie and still be taken for rounding; such values are clipped."""


def psnr(render: Tensor, target: Tensor) -> float:
    """Peak signal-to-noise ratio, 10 log10(1 / mean squared error) over pixels and channels.

    Args:
        render: image [H, W, 3], floating point, in [0, 1].
        target: image of the same shape and range.

    Returns:
        Decibels; `inf` where the images are equal.

    Raises:
        ValueError: an image is no finite floating-point [H, W, 3] in [0, 1], or the shapes differ.
    """
    render, target = _image_pair(render, target)
    mean_squared_error = (render - target).square().mean().item()
    return math.inf if mean_squared_error == 0 else -10 * math.log10(mean_squared_error)


def ssim(render: Tensor, target: Tensor) -> float:
    """Structural similarity with an 11 x 11 Gaussian window of sigma 1.5 and "valid" padding.

    "Valid": only windows that lie wholly inside the image count, so the outer 5 pixels are never a window's
    center. torchmetrics, and with it `ns-eval`, pads by reflection instead; its numbers differ slightly. Mean over
    channels and windows. Wang et al. 2004, "Image quality assessment: from error visibility to structural
    similarity", with K1 = 0.01 and K2 = 0.03.

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
    # The library's own window has single precision: it sums to 1 only within 1e-7, which flat regions show.
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
    """The two images [H, W, 3] as `flip_error` takes them, reference first.

    Raises:
        ValueError: as `psnr`.
    """
    render, target = _image_pair(render, target)
    reference, test = (np.ascontiguousarray(image.float().cpu().numpy()) for image in (target, render))
    return reference, test


def mean_color_deviation(render: Tensor, target: Tensor) -> float:
    """Distance between the two images' mean colors, the paper's Delta c-bar.

    The 2-norm of the difference of mean RGB on the 0..255 scale. It shows a near-uniform tint or exposure
    shift that hardly moves PSNR or SSIM.

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


def matte_iou(alpha: Tensor, mask: Tensor, threshold: float = 0.5) -> float:
    """Intersection over union of a thresholded matte and the true mask.

    Args:
        alpha: matte A [H, W], floating point, in [0, 1].
        mask: true artifact mask [H, W], bool.
        threshold: a pixel counts as artifact where alpha > threshold; in [0, 1).

    Returns:
        A number in [0, 1]; 1 where both are empty.

    Raises:
        ValueError: alpha is no finite floating-point [H, W] in [0, 1], mask is not bool or of another shape,
            or the threshold is out of range.
    """
    alpha = _checked(alpha, "alpha", dimensions=2)
    if mask.dtype != torch.bool or mask.shape != alpha.shape:
        raise ValueError(f"mask must be bool {tuple(alpha.shape)}, got {mask.dtype} {tuple(mask.shape)}")
    if not 0 <= threshold < 1:
        raise ValueError(f"threshold must be in [0, 1), got {threshold}")
    found, true = alpha > threshold, mask.to(alpha.device)
    union = (found | true).sum().item()
    return 1.0 if union == 0 else (found & true).sum().item() / union


def matte_error(alpha: Tensor, target: Tensor) -> float:
    """Mean absolute error between two mattes.

    Args:
        alpha: matte A [H, W], floating point, in [0, 1].
        target: true matte [H, W], same range.

    Returns:
        A number in [0, 1].

    Raises:
        ValueError: a matte is no finite floating-point [H, W] in [0, 1], or the shapes differ.
    """
    alpha, target = _checked(alpha, "alpha", dimensions=2), _checked(target, "target", dimensions=2)
    if alpha.shape != target.shape:
        raise ValueError(f"alpha {tuple(alpha.shape)} and target {tuple(target.shape)} differ in shape")
    return (alpha - target.to(alpha.device)).abs().mean().item()


def _image_pair(render: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    render, target = _checked(render, "render", dimensions=3), _checked(target, "target", dimensions=3)
    if render.shape != target.shape:
        raise ValueError(f"render {tuple(render.shape)} and target {tuple(target.shape)} differ in shape")
    return render, target.to(render.device)


def _checked(image: Tensor, name: str, dimensions: int) -> Tensor:
    """The image in float64, clipped to [0, 1].

    Double precision because single-precision convolutions run as TF32 on recent GPUs and the variance inside
    SSIM is a difference of close numbers.
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
