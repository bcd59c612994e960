"""Displacement of scene edges: how much of the views' differences a displacement of their mean explains.

A distant scene hardly moves during a short walk, and its gradients seem static. But what moves of it moves together.
Source: Lucas and Kanade 1981, with exposure as two more unknowns (docs/detect.md).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ssa_nerfstudio.evidence.guided_upsampling import window_mean
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL

_LEAST_VARIANCE = (GRAY_LEVEL / 2) ** 2


def displaced_share(images: Tensor, gradient: Tensor, window: int) -> Tensor:
    """Share of the images' deviations from their mean that displacing this mean explains.

    In the window around each pixel, every image has its own displacement d, fitted by least squares to deviation =
    constant + gain x mean + d . gradient of the mean. Constant and gain account for exposure, and for soft artifacts:
    behind their edges the scene fades, which alone resembles a displacement. What these two explain does not count.

    Args:
        images: [K, h, w].
        gradient: of their mean, [2, h, w], along x and y.
        window: side of the window, pixels, odd.

    Returns:
        [h, w] in [0, 1].
    """
    basis = torch.cat([images.mean(dim=0, keepdim=True), gradient])
    levels = window_mean(basis, window)
    mean_mean, mean_x, mean_y = window_mean(basis[:1] * basis, window) - levels[:1] * levels
    gain = torch.stack([mean_x, mean_y]) / mean_mean.clamp_min(_LEAST_VARIANCE)
    xx, yy = window_mean(gradient.square(), window) - levels[1:].square() - gain * torch.stack([mean_x, mean_y])
    xy = (window_mean(gradient[:1] * gradient[1:], window) - levels[1:2] * levels[2:])[0] - gain[0] * mean_y
    # A displacement along a straight edge is undetermined: 1 % more variance keeps it near 0 there.
    ridge = 0.01 * (xx + yy).clamp_min(torch.finfo(images.dtype).eps)
    xx, yy = xx + ridge, yy + ridge
    determinant = (xx * yy - xy.square()).clamp_min(ridge.square())
    deviations = images - basis[0]
    level = window_mean(deviations, window)
    products = window_mean((basis[:, None] * deviations).flatten(0, 1), window).unflatten(0, (3, len(images)))
    with_mean, *with_gradient = products - levels[:, None] * level
    x, y = torch.stack(with_gradient) - gain[:, None] * with_mean
    fits = (yy * x.square() - 2 * xy * x * y + xx * y.square()) / determinant
    variances = window_mean(deviations.square(), window) - level.square()
    explained, total = torch.zeros_like(images[0]), torch.zeros_like(images[0])
    for fit, variance in zip(fits, variances, strict=True):  # one after the other: the same sum on any device
        explained += fit
        total += variance
    return (explained / total.clamp_min(len(images) * _LEAST_VARIANCE)).clamp(0, 1)
