# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# (Type checkers do not understand Triton's kernels.)
"""L1 + SSIM and its gradient on CUDA: four Triton kernels, each bound by memory bandwidth. See `photometric_loss`.

Images stay [H, W, C]: a shift by one pixel is a shift by C in memory, the same for all channels. Partial sums of the
loss are written per block and added by torch, in an order that does not change from run to run.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 512


def value_and_gradient(
    prediction: Tensor, target: Tensor, ssim_weight: float, window: tuple[float, ...]
) -> tuple[Tensor, Tensor]:
    """Compute the loss and its gradient with respect to the prediction.

    Args:
        prediction, target: [H, W, C] on a CUDA device.
        ssim_weight: w in [0, 1].
        window: [K] weights that sum to 1, symmetric.

    Returns:
        The loss, a float32 scalar, and its gradient [H, W, C] of the prediction's dtype, both on the device.
    """
    x, y = prediction.float().contiguous(), target.float().contiguous()
    height, width, channels = x.shape
    size = len(window)
    rows, columns = height - size + 1, width - size + 1
    weights = _window_on(x.device, window)
    line, full_line = columns * channels, width * channels
    blurred = x.new_empty(4, height * line)
    slopes = x.new_empty(3, rows * line)
    spread = x.new_empty(3, height * line)
    gradient = torch.empty_like(x)
    blocks = [triton.cdiv(n, _BLOCK) for n in (height * line, rows * line, height * full_line)]
    shares = x.new_empty(blocks[1] + blocks[2])
    l1_scale = (1.0 - ssim_weight) / x.numel()
    ssim_scale = ssim_weight / (rows * line)
    _blur_rows[(blocks[0],)](x, y, weights, blurred, height * line, line, full_line, channels, size, _BLOCK)
    _slopes[(blocks[1],)](
        blurred, weights, slopes, shares, rows * line, height * line, line, -ssim_scale, size, _BLOCK
    )  # fmt: skip
    _spread_columns[(blocks[0],)](slopes, weights, spread, height * line, rows * line, line, size, _BLOCK)
    _gradient[(blocks[2],)](
        x, y, weights, spread, gradient, shares[blocks[1] :], height * full_line, height * line, line, full_line,
        channels, l1_scale, -ssim_scale, size, _BLOCK,
    )  # fmt: skip
    return shares.sum() + ssim_weight, gradient.to(prediction.dtype)


# Copied to a device once: a copy at every step would wait for it.
_windows: dict[tuple[torch.device, tuple[float, ...]], Tensor] = {}


def _window_on(device: torch.device, window: tuple[float, ...]) -> Tensor:
    key = device, window
    if key not in _windows:
        _windows[key] = torch.tensor(window, device=device)
    return _windows[key]


@triton.jit
def _blur_rows(x_ptr, y_ptr, window, out, n, line, full_line, C, SIZE: tl.constexpr, BLOCK: tl.constexpr):
    """Horizontal window over x, y, x^2 + y^2 and xy: out [4, H, W', C]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    source = (i // line) * full_line + i % line
    a = tl.zeros([BLOCK], tl.float32)
    b = tl.zeros([BLOCK], tl.float32)
    q = tl.zeros([BLOCK], tl.float32)
    p = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(SIZE):
        weight = tl.load(window + k)
        x = tl.load(x_ptr + source + k * C, mask=inside, other=0.0)
        y = tl.load(y_ptr + source + k * C, mask=inside, other=0.0)
        a += weight * x
        b += weight * y
        q += weight * (x * x + y * y)
        p += weight * (x * y)
    tl.store(out + i, a, mask=inside)
    tl.store(out + n + i, b, mask=inside)
    tl.store(out + 2 * n + i, q, mask=inside)
    tl.store(out + 3 * n + i, p, mask=inside)


@triton.jit
def _slopes(blurred, window, slopes, shares, n, plane, line, ssim_scale, SIZE: tl.constexpr, BLOCK: tl.constexpr):
    """Vertical window, then S and its derivatives by mean x, E[x^2 + y^2], E[xy]: slopes [3, H', W', C]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    a = tl.zeros([BLOCK], tl.float32)
    b = tl.zeros([BLOCK], tl.float32)
    q = tl.zeros([BLOCK], tl.float32)
    p = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(SIZE):
        weight = tl.load(window + k)
        a += weight * tl.load(blurred + i + k * line, mask=inside, other=0.0)
        b += weight * tl.load(blurred + plane + i + k * line, mask=inside, other=0.0)
        q += weight * tl.load(blurred + 2 * plane + i + k * line, mask=inside, other=0.0)
        p += weight * tl.load(blurred + 3 * plane + i + k * line, mask=inside, other=0.0)
    squares = a * a + b * b
    product = a * b
    n1 = 2 * product + 0.0001
    d1 = squares + 0.0001
    n2 = 2 * (p - product) + 0.0009
    d2 = q - squares + 0.0009
    inverse = 1.0 / (d1 * d2)
    s = n1 * n2 * inverse
    tl.store(slopes + i, 2 * b * (n2 - n1) * inverse + 2 * a * s * (d1 - d2) * inverse, mask=inside)
    tl.store(slopes + n + i, -s * d1 * inverse, mask=inside)
    tl.store(slopes + 2 * n + i, 2 * n1 * inverse, mask=inside)
    tl.store(shares + tl.program_id(0), ssim_scale * tl.sum(tl.where(inside, s, 0.0)))


@triton.jit
def _spread_columns(slopes, window, spread, n, plane, line, SIZE: tl.constexpr, BLOCK: tl.constexpr):
    """The vertical window transposed: spread [3, H, W', C]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    a = tl.zeros([BLOCK], tl.float32)
    q = tl.zeros([BLOCK], tl.float32)
    p = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(SIZE):
        weight = tl.load(window + k)
        source = i - k * line
        valid = inside & (source >= 0) & (source < plane)
        a += weight * tl.load(slopes + source, mask=valid, other=0.0)
        q += weight * tl.load(slopes + plane + source, mask=valid, other=0.0)
        p += weight * tl.load(slopes + 2 * plane + source, mask=valid, other=0.0)
    tl.store(spread + i, a, mask=inside)
    tl.store(spread + n + i, q, mask=inside)
    tl.store(spread + 2 * n + i, p, mask=inside)


@triton.jit
def _gradient(
    x_ptr, y_ptr, window, spread, gradient, shares, n, plane, line, full_line, C, l1_scale, ssim_scale,
    SIZE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The horizontal window transposed, chained to the pixels, and the L1 term: gradient [H, W, C]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    row = i // full_line
    within = i % full_line
    a = tl.zeros([BLOCK], tl.float32)
    q = tl.zeros([BLOCK], tl.float32)
    p = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(SIZE):
        weight = tl.load(window + k)
        offset = within - k * C
        valid = inside & (offset >= 0) & (offset < line)
        source = row * line + offset
        a += weight * tl.load(spread + source, mask=valid, other=0.0)
        q += weight * tl.load(spread + plane + source, mask=valid, other=0.0)
        p += weight * tl.load(spread + 2 * plane + source, mask=valid, other=0.0)
    x = tl.load(x_ptr + i, mask=inside, other=0.0)
    y = tl.load(y_ptr + i, mask=inside, other=0.0)
    sign = tl.where(x > y, 1.0, tl.where(x < y, -1.0, 0.0))
    tl.store(gradient + i, l1_scale * sign + ssim_scale * (a + 2 * x * q + y * p), mask=inside)
    tl.store(shares + tl.program_id(0), l1_scale * tl.sum(tl.where(inside, tl.abs(x - y), 0.0)))
