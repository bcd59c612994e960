# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false
# (Type checkers do not understand Triton's kernels.)
"""`tile_lists.tile_lists` on CUDA: two Triton kernels around a running sum, and a sort by tile.

Of gsplat's tiles, those in the square of three standard deviations, a Gaussian is listed where its ellipse of alpha
ALPHA_MIN comes near the center of a pixel. A row of tiles cuts a strip out of the ellipse, and that is convex: its
extent along x tells the tiles of the row.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from ssa_nerfstudio.rasterization.constants import ALPHA_MIN, TILE

_BLOCK, _WARPS = 32, 1
_MOST_OF_16_BITS = 2**15 - 1


def listed(
    means2d: Tensor, conics: Tensor, alphas: Tensor, depths: Tensor, radii: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """As `tile_lists.tile_lists`, of N > 0 Gaussians in one camera."""
    n, columns, rows = len(radii), math.ceil(width / TILE), math.ceil(height / TILE)
    grid = (triton.cdiv(n, _BLOCK),)
    nearest_first = depths.argsort(stable=True)
    given = [each.contiguous() for each in (nearest_first, means2d, conics, alphas, radii)]
    counts = torch.empty(n, dtype=torch.int32, device=depths.device)
    _count[grid](*given, counts, n, columns, rows, 1 / ALPHA_MIN, TILE, _BLOCK, num_warps=_WARPS)
    ends = counts.cumsum(0)  # int64
    total = int(ends[-1])
    narrow = columns * rows <= _MOST_OF_16_BITS  # half as many passes of the sort
    tiles = torch.empty(total, dtype=torch.int16 if narrow else torch.int32, device=depths.device)
    ids = torch.empty(total, dtype=torch.int32, device=depths.device)
    if total:
        _list[grid](*given, counts, ends, tiles, ids, n, columns, rows, 1 / ALPHA_MIN, TILE, _BLOCK, num_warps=_WARPS)
    tiles, order = tiles.sort(stable=True)
    every = torch.arange(columns * rows, dtype=tiles.dtype, device=tiles.device)
    return torch.searchsorted(tiles, every, out_int32=True).reshape(rows, columns), ids[order]


@triton.jit
def _ellipse(order, means2d, conics, alphas, radii, i, inside, columns, rows, inverse_alpha_min, TILE: tl.constexpr):
    """Of a Gaussian, its ellipse and the tiles of its square: first columns and rows, and those after the last."""
    g = tl.load(order + i, mask=inside, other=0)
    radius = tl.load(radii + g, mask=inside, other=0).to(tl.float32)
    alpha = tl.load(alphas + g, mask=inside, other=0.0)
    drawn = inside & (radius > 0) & ~(alpha * inverse_alpha_min < 0.999)  # what is not a number is drawn
    x, y = tl.load(means2d + 2 * g, mask=inside, other=0.0), tl.load(means2d + 2 * g + 1, mask=inside, other=0.0)
    a = tl.load(conics + 3 * g, mask=inside, other=1.0)
    b = tl.load(conics + 3 * g + 1, mask=inside, other=0.0)
    c = tl.load(conics + 3 * g + 2, mask=inside, other=1.0)
    reach, column, row = radius / TILE, x / TILE, y / TILE
    left, right = _within(tl.floor(column - reach), columns), _within(tl.ceil(column + reach), columns)
    top, bottom = _within(tl.floor(row - reach), rows), tl.where(drawn, _within(tl.ceil(row + reach), rows), 0)
    # Without the error of the product, which may be all of the difference where an ellipse is thin.
    product = b * b
    determinant = tl.fma(a, c, -product) - tl.fma(b, b, -product)
    determinant = tl.where(determinant > 0, determinant, 0.0)  # of 0, the ellipse is all of the square
    # Twice the exponent at which alpha is ALPHA_MIN, and what blending's own rounding may add.
    ratio = alpha * inverse_alpha_min
    square = 2 * tl.log(tl.where(ratio < 1, 1.0, ratio)) + 0.02
    square += 4e-6 * square * a * c / determinant
    height = tl.sqrt(square * a / determinant)
    slope = -b / c * tl.sqrt(square * c / determinant)  # where on the ellipse x is largest
    return x, y, a, b, square, determinant, height, slope, left, right, top, bottom


@triton.jit
def _within(value, most):
    """A number as an int in [0, most]; what is not a number is 0."""
    return tl.where(value > 0, tl.where(value < most, value, most), 0.0).to(tl.int32)


@triton.jit
def _columns(row, x, y, a, b, square, determinant, height, slope, left, right, TILE: tl.constexpr):
    """First column, and the one after the last, in which a row of tiles meets an ellipse."""
    # Of the centers of pixels, which lie half a pixel inside of a tile; and a hundredth more, here and below.
    low, high = row * TILE + 0.49 - y, row * TILE + (TILE - 0.49) - y
    low, high = tl.where(low > -height, low, -height), tl.where(high < height, high, height)
    at_right = tl.where(slope < low, low, tl.where(slope > high, high, slope))
    at_left = tl.where(-slope < low, low, tl.where(-slope > high, high, -slope))
    right_half = square * a - determinant * at_right * at_right
    left_half = square * a - determinant * at_left * at_left
    end = x + (tl.sqrt(tl.where(right_half < 0, 0.0, right_half)) - b * at_right) / a
    begin = x - (tl.sqrt(tl.where(left_half < 0, 0.0, left_half)) + b * at_left) / a
    first = tl.ceil((begin - (TILE - 0.49)) / TILE)
    last = tl.floor((end - 0.49) / TILE) + 1
    # What is not a number keeps all of its square.
    first = tl.where(first > left, tl.where(first < right, first, right), left).to(tl.int32)
    last = tl.where(last < right, tl.where(last > left, last, left), right).to(tl.int32)
    return first, tl.where((low > high) | (last < first), first, last)


@triton.jit(do_not_specialize=["n", "columns", "rows"])
def _count(
    order, means2d, conics, alphas, radii, counts, n, columns, rows, inverse_alpha_min, TILE: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """How many tiles list each Gaussian, nearest first."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    x, y, a, b, square, determinant, height, slope, left, right, top, bottom = _ellipse(
        order, means2d, conics, alphas, radii, i, inside, columns, rows, inverse_alpha_min, TILE
    )
    found = tl.zeros_like(left)
    row, most = top, tl.max(bottom - top, axis=0)
    while most > 0:
        first, last = _columns(row, x, y, a, b, square, determinant, height, slope, left, right, TILE)
        found += tl.where(row < bottom, last - first, 0)
        row += 1
        most -= 1
    tl.store(counts + i, found, mask=inside)


@triton.jit(do_not_specialize=["n", "columns", "rows"])
def _list(
    order, means2d, conics, alphas, radii, counts, ends, tiles, ids, n, columns, rows, inverse_alpha_min,
    TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Tile and Gaussian of each entry, in the Gaussians' order."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    x, y, a, b, square, determinant, height, slope, left, right, top, bottom = _ellipse(
        order, means2d, conics, alphas, radii, i, inside, columns, rows, inverse_alpha_min, TILE
    )
    g = tl.load(order + i, mask=inside, other=0)
    place = tl.load(ends + i, mask=inside, other=0) - tl.load(counts + i, mask=inside, other=0)
    row, most = top, tl.max(bottom - top, axis=0)
    while most > 0:
        first, last = _columns(row, x, y, a, b, square, determinant, height, slope, left, right, TILE)
        number = tl.where(row < bottom, last - first, 0)
        tile, left_over = row * columns + first, tl.max(number, axis=0)
        while left_over > 0:
            tl.store(tiles + place, tile.to(tiles.dtype.element_ty), mask=number > 0)
            tl.store(ids + place, g.to(tl.int32), mask=number > 0)
            place += (number > 0).to(tl.int64)
            tile += 1
            number -= 1
            left_over -= 1
        row += 1
        most -= 1
