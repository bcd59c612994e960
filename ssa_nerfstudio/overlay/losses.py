"""The loss terms: photometric (L1 and SSIM) and sparsity of the matte. Pure functions; every term is a mean over pixels."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor

Sparsity = Literal["l1", "log", "off"]

LOG_SOFTNESS = 0.1
"""e of the concave penalty log(1 + A / e): below this opacity it acts like l1, above it spares what is opaque anyway."""
LOG_EVIDENCE_FLOOR = 0.1
"""Share of the concave penalty that a pixel pays whose colour is the same in all views."""
SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window in pixels (sigma 1.5), "valid" padding: as pytorch_msssim and the paper's code base."""


def photometric(prediction: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """(1 - w) mean |prediction - target| + w (1 - SSIM) (paper, equation of L_rgb; w = 0.2).

    Images of less than 11 pixels a side have no window for SSIM and are compared by L1 alone.

    Args:
        prediction, target: [H, W, 3] in [0, 1].
        ssim_weight: w in [0, 1]; at 0 SSIM is not computed.
    """
    l1 = (prediction - target).abs().mean()
    if ssim_weight == 0 or min(prediction.shape[:2]) < SSIM_WINDOW:
        return l1
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ssim(prediction, target))


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity over the positions where the whole 11 x 11 window fits ("valid" padding).

    K1 = 0.01, K2 = 0.03, data range 1 (Wang et al. 2004). On CUDA the separable window is two sums of shifted images:
    they compile, with everything around them, into a few kernels; convolutions would not.

    Args:
        prediction, target: [H, W, 3] in [0, 1], at least 11 pixels a side.
    """
    x, y = prediction.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_x, mean_y, squares, product = _blur(torch.cat([x, y, x * x + y * y, x * y])).chunk(4)
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
    weight = LOG_EVIDENCE_FLOOR + (1.0 - LOG_EVIDENCE_FLOOR) * evidence
    return (weight * torch.log1p(matte / LOG_SOFTNESS)).mean() / math.log1p(1.0 / LOG_SOFTNESS)


def _blur(planes: Tensor) -> Tensor:
    """Gaussian window over planes [C, H, W], "valid": [C, H - 10, W - 10]."""
    if planes.device.type == "cpu":
        # Products with the banded window matrix: without a compiler the fastest form at the sizes a CPU trains at.
        rows, columns = (_window_matrix(size, planes.dtype) for size in planes.shape[1:])
        return rows @ (planes @ columns.T)
    for dim in (1, 2):
        length = planes.shape[dim] - SSIM_WINDOW + 1
        planes = sum(weight * planes.narrow(dim, shift, length) for shift, weight in enumerate(_window()))  # pyright: ignore
    return planes


@lru_cache(maxsize=1)
def _window() -> tuple[float, ...]:
    values = [math.exp(-((i - SSIM_WINDOW // 2) ** 2) / (2 * 1.5**2)) for i in range(SSIM_WINDOW)]
    return tuple(v / sum(values) for v in values)


@lru_cache(maxsize=32)
def _window_matrix(size: int, dtype: torch.dtype) -> Tensor:
    """The window at each of its positions along `size` pixels: [size - 10, size]."""
    matrix = torch.zeros(size - SSIM_WINDOW + 1, size, dtype=dtype)
    for shift, weight in enumerate(_window()):
        matrix.diagonal(shift).fill_(weight)
    return matrix
