# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# (Type checkers do not understand Triton's kernels.)
"""`harmonics.shade` on CUDA and its gradient, one Triton kernel each.

The bases are the real spherical harmonics of 3D Gaussian Splatting (arXiv 2308.04079), as polynomials of the unit
direction. The first coefficient and the rest are read where splatfacto keeps them: nothing is concatenated.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 128


def colors_of(means: Tensor, center: Tensor, constant: Tensor, rest: Tensor, radii: Tensor, degree: int) -> Tensor:
    """Colors [N, 3]; arguments as of `harmonics.shade`, contiguous float32 on the device."""
    colors = torch.empty_like(constant)
    n = len(means)
    _evaluate[(triton.cdiv(n, _BLOCK),)](
        means, center, constant, rest, radii, colors, n, 3 * rest.shape[1], degree, _BLOCK
    )  # fmt: skip
    return colors


def gradients_of(
    means: Tensor, center: Tensor, rest: Tensor, radii: Tensor, colors: Tensor, slopes: Tensor, degree: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of means [N, 3], the first coefficient [N, 3] and the others [N, K, 3], given those of the colors."""
    of_means, of_constant, of_rest = torch.empty_like(means), torch.empty_like(colors), torch.empty_like(rest)
    n = len(means)
    _differentiate[(triton.cdiv(n, _BLOCK),)](
        means, center, rest, radii, colors, slopes, of_means, of_constant, of_rest, n, 3 * rest.shape[1],
        max(1, triton.next_power_of_2(3 * rest.shape[1])), degree, _BLOCK,
    )  # fmt: skip
    return of_means, of_constant, of_rest


@triton.jit
def _direction(means, center, i, drawn):
    """Unit directions from the camera and the inverse of the distances; both 0 at the camera itself."""
    x = tl.load(means + 3 * i, mask=drawn, other=0.0) - tl.load(center)
    y = tl.load(means + 3 * i + 1, mask=drawn, other=0.0) - tl.load(center + 1)
    z = tl.load(means + 3 * i + 2, mask=drawn, other=0.0) - tl.load(center + 2)
    square = x * x + y * y + z * z
    inverse = tl.where(square > 0, 1.0 / tl.sqrt(tl.where(square > 0, square, 1.0)), 0.0)
    return x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def _basis(k: tl.constexpr, x, y, z):
    """The k-th basis function, 1 <= k <= 15, and its derivatives by x, y and z."""
    nothing = tl.zeros_like(x)
    value, by_x, by_y, by_z = nothing, nothing, nothing, nothing
    if k == 1:
        value = -0.4886025119029199 * y
        by_y = nothing - 0.4886025119029199
    elif k == 2:
        value = 0.4886025119029199 * z
        by_z = nothing + 0.4886025119029199
    elif k == 3:
        value = -0.4886025119029199 * x
        by_x = nothing - 0.4886025119029199
    elif k == 4:
        by_x, by_y = 1.0925484305920792 * y, 1.0925484305920792 * x
        value = by_x * x
    elif k == 5:
        by_y, by_z = -1.0925484305920792 * z, -1.0925484305920792 * y
        value = by_y * y
    elif k == 6:
        value = 0.9461746957575601 * z * z - 0.31539156525252005
        by_z = 1.8923493915151202 * z
    elif k == 7:
        by_x, by_z = -1.0925484305920792 * z, -1.0925484305920792 * x
        value = by_x * x
    elif k == 8:
        value = 0.5462742152960396 * (x * x - y * y)
        by_x, by_y = 1.0925484305920792 * x, -1.0925484305920792 * y
    elif k == 9:
        value = -0.5900435899266435 * y * (3.0 * x * x - y * y)
        by_x, by_y = -3.540261539559861 * x * y, -1.7701307697799304 * (x * x - y * y)
    elif k == 10:
        by_x, by_y, by_z = 2.890611442640554 * y * z, 2.890611442640554 * x * z, 2.890611442640554 * x * y
        value = by_x * x
    elif k == 11:
        by_y, by_z = -0.4570457994644658 * (5.0 * z * z - 1.0), -4.570457994644658 * y * z
        value = by_y * y
    elif k == 12:
        value = 0.3731763325901154 * z * (5.0 * z * z - 3.0)
        by_z = 1.1195289977703462 * (5.0 * z * z - 1.0)
    elif k == 13:
        by_x, by_z = -0.4570457994644658 * (5.0 * z * z - 1.0), -4.570457994644658 * x * z
        value = by_x * x
    elif k == 14:
        by_z = 1.445305721320277 * (x * x - y * y)
        value = by_z * z
        by_x, by_y = 2.890611442640554 * x * z, -2.890611442640554 * y * z
    else:
        value = -0.5900435899266435 * x * (x * x - 3.0 * y * y)
        by_x, by_y = -1.7701307697799304 * (x * x - y * y), 3.540261539559861 * x * y
    return value, by_x, by_y, by_z


@triton.jit(do_not_specialize=["n"])  # it changes: one compilation for all of its values
def _evaluate(
    means, center, constant, rest, radii, colors, n, STRIDE: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """max(0, sum_k b_k c_k + 0.5), and 0 for what is not drawn."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    drawn = inside & (tl.load(radii + i, mask=inside, other=0) > 0)
    x, y, z, _ = _direction(means, center, i, drawn)
    red = 0.28209479177387814 * tl.load(constant + 3 * i, mask=drawn, other=0.0)
    green = 0.28209479177387814 * tl.load(constant + 3 * i + 1, mask=drawn, other=0.0)
    blue = 0.28209479177387814 * tl.load(constant + 3 * i + 2, mask=drawn, other=0.0)
    for k in tl.static_range(1, (DEGREE + 1) * (DEGREE + 1)):
        value, _, _, _ = _basis(k, x, y, z)
        at = rest + STRIDE * i + 3 * (k - 1)
        red += value * tl.load(at, mask=drawn, other=0.0)
        green += value * tl.load(at + 1, mask=drawn, other=0.0)
        blue += value * tl.load(at + 2, mask=drawn, other=0.0)
    # Written so that what is not finite stays so.
    tl.store(colors + 3 * i, tl.where(drawn & ~(red < -0.5), red + 0.5, 0.0), mask=inside)
    tl.store(colors + 3 * i + 1, tl.where(drawn & ~(green < -0.5), green + 0.5, 0.0), mask=inside)
    tl.store(colors + 3 * i + 2, tl.where(drawn & ~(blue < -0.5), blue + 0.5, 0.0), mask=inside)


@triton.jit(do_not_specialize=["n"])
def _differentiate(
    means, center, rest, radii, colors, slopes, of_means, of_constant, of_rest, n, STRIDE: tl.constexpr,
    COLUMNS: tl.constexpr, DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Of a basis function b, d/d mean is (I - u u^T) grad b / |mean - center| with the unit direction u.

    A Gaussian's coefficients lie side by side, so their gradients are stored at once: one by one, each would be a write
    of its own to a sector of memory.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    drawn = inside & (tl.load(radii + i, mask=inside, other=0) > 0)
    x, y, z, inverse = _direction(means, center, i, drawn)
    red = _passed(colors, slopes, 3 * i, drawn)
    green = _passed(colors, slopes, 3 * i + 1, drawn)
    blue = _passed(colors, slopes, 3 * i + 2, drawn)
    tl.store(of_constant + 3 * i, 0.28209479177387814 * red, mask=inside)
    tl.store(of_constant + 3 * i + 1, 0.28209479177387814 * green, mask=inside)
    tl.store(of_constant + 3 * i + 2, 0.28209479177387814 * blue, mask=inside)
    along_x, along_y, along_z = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    column = tl.arange(0, COLUMNS)
    values = tl.zeros([BLOCK, COLUMNS], dtype=tl.float32)
    for k in tl.static_range(1, (DEGREE + 1) * (DEGREE + 1)):
        at = STRIDE * i + 3 * (k - 1)
        value, by_x, by_y, by_z = _basis(k, x, y, z)
        slope = red * tl.load(rest + at, mask=drawn, other=0.0)
        slope += green * tl.load(rest + at + 1, mask=drawn, other=0.0)
        slope += blue * tl.load(rest + at + 2, mask=drawn, other=0.0)
        along_x += slope * by_x
        along_y += slope * by_y
        along_z += slope * by_z
        values = tl.where((column // 3 == k - 1)[None, :], value[:, None], values)
    channel = (column % 3)[None, :]
    values *= tl.where(channel == 0, red[:, None], tl.where(channel == 1, green[:, None], blue[:, None]))
    counts = (column < 3 * ((DEGREE + 1) * (DEGREE + 1) - 1))[None, :]
    tl.store(
        of_rest + STRIDE * i[:, None] + column[None, :], tl.where(counts, values, 0.0),
        mask=inside[:, None] & (column < STRIDE)[None, :],
    )  # fmt: skip
    radial = along_x * x + along_y * y + along_z * z
    tl.store(of_means + 3 * i, inverse * (along_x - radial * x), mask=inside)
    tl.store(of_means + 3 * i + 1, inverse * (along_y - radial * y), mask=inside)
    tl.store(of_means + 3 * i + 2, inverse * (along_z - radial * z), mask=inside)


@triton.jit
def _passed(colors, slopes, at, drawn):
    """The gradient of what was clamped to 0 from below."""
    color = tl.load(colors + at, mask=drawn, other=0.0)
    return tl.where(color > 0, tl.load(slopes + at, mask=drawn & (color > 0), other=0.0), 0.0)
