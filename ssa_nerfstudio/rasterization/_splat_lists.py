"""Numba kernels of the `cpu` rasterizer that prepare splats for blending: their shape, their extent, their bands.

A band is one row of 16 x 16 tiles. Completing the square along a row of pixels writes the exponent of a Gaussian as

    sigma(x, y) = narrowness (x - center_x + shear dy)^2 + falloff dy^2,   dy = y - center_y,

which has no cancellation, and whose roots bound the pixels with alpha >= 1/255: on a row, and, where the first term is
zero, over rows.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ssa_nerfstudio.rasterization.constants import ALPHA_MIN, TILE

BLOCK = 8
"""Pixels of a row that are blended together; a tile is whole blocks."""
SHAPE = 8
"""Columns of a splat's shape: center x y, shear, narrowness and its inverse, falloff, largest sigma drawn, opacity."""


@njit(cache=True, nogil=True, error_model="numpy")
def shape_splats(thread, threads, centers, conics, opacities, radii, width, height, shapes, bounds):
    """Fill shapes [V, SHAPE] float64 and bounds [V, 4] int32: columns x0, x1 and rows y0, y1, half open, of the image.

    The columns are those of the tiles that the three-sigma square of `radii` [V] touches; the rows are also those where
    alpha reaches 1/255. Where nothing is drawn, the bounds are empty, that is zero.
    """
    n = centers.shape[0]
    for v in range(n * thread // threads, n * (thread + 1) // threads):
        cx, cy, radius = float(centers[v, 0]), float(centers[v, 1]), float(radii[v])
        xx, xy, yy = float(conics[v, 0]), float(conics[v, 1]), float(conics[v, 2])
        opacity = float(opacities[v])
        bounds[v, :] = 0
        if not (opacity >= ALPHA_MIN and xx > 0.0):
            continue
        sigma_max = math.log(opacity / ALPHA_MIN)
        falloff = 0.5 * max(yy - xy * xy / xx, 0.0)
        reach = math.sqrt(sigma_max / falloff)
        x0 = max(math.floor((cx - radius) / TILE) * TILE, 0.0)
        x1 = min(math.ceil((cx + radius) / TILE) * TILE, width)
        y0 = max(math.floor((cy - radius) / TILE) * TILE, 0.0, math.ceil(cy - reach - 0.5))
        y1 = min(math.ceil((cy + radius) / TILE) * TILE, height, math.floor(cy + reach - 0.5) + 1.0)
        if not (x0 < x1 and y0 < y1):
            continue
        bounds[v, 0], bounds[v, 1], bounds[v, 2], bounds[v, 3] = x0, x1, y0, y1
        shapes[v, 0], shapes[v, 1], shapes[v, 2] = cx, cy, xy / xx
        shapes[v, 3], shapes[v, 4], shapes[v, 5] = 0.5 * xx, 2.0 / xx, falloff
        shapes[v, 6], shapes[v, 7] = sigma_max, opacity


@njit(cache=True, nogil=True, inline="always")
def extent_of_splat(shapes, bounds, v):
    """What `row_of_splat` needs of splat v: center x y, shear, falloff, inverse narrowness, largest sigma, blocks."""
    first, end = bounds[v, 0] // BLOCK, (bounds[v, 1] + BLOCK - 1) // BLOCK
    return shapes[v, 0], shapes[v, 1], shapes[v, 2], shapes[v, 5], shapes[v, 4], shapes[v, 6], first, end


@njit(cache=True, forceinline=True, error_model="numpy")
def row_of_splat(extent, y):
    """Where a splat is drawn on row y: dy, falloff dy^2, the x of its middle, and blocks [first, end) of the row.

    Pixels have whole x and y here, their centers included. No fast math: forward and backward find the same blocks.
    """
    cx, cy, shear, falloff, inverse, sigma_max, first, end = extent
    dy = y + 0.5 - cy
    sigma = falloff * dy * dy
    middle = cx - shear * dy - 0.5
    half = math.sqrt(max(sigma_max - sigma, 0.0) * inverse)
    left, right = (middle - half) / BLOCK, (middle + half) / BLOCK
    return dy, sigma, middle, int(left) if left > first else first, int(right) + 1 if right < end - 1 else end


@njit(cache=True, nogil=True)
def assign_bands(bounds, n_bands):
    """List each band's splats, nearest first.

    Args:
        bounds: [V, 4] int32 of `shape_splats`.

    Returns:
        starts [B + 1] and members [S]: band b draws splats members[starts[b] : starts[b + 1]];
        slots [V + 1]: splat v writes its gradients for its k-th band to row slots[v] + k.
    """
    n = bounds.shape[0]
    slots = np.zeros(n + 1, np.int64)
    starts = np.zeros(n_bands + 1, np.int64)
    for v in range(n):
        first, last = bounds[v, 2] // TILE, (bounds[v, 3] + TILE - 1) // TILE
        slots[v + 1] = slots[v] + last - first
        for band in range(first, last):
            starts[band + 1] += 1
    for band in range(n_bands):
        starts[band + 1] += starts[band]
    members = np.empty(starts[n_bands], np.int32)
    filled = starts[:-1].copy()
    for v in range(n):
        first = bounds[v, 2] // TILE
        for band in range(first, first + slots[v + 1] - slots[v]):
            members[filled[band]] = v
            filled[band] += 1
    return starts, members, slots
