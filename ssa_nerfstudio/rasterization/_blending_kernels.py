"""Numba kernels of the `cpu` rasterizer: splats are blended band by band, a band being one row of 16 x 16 tiles.

A band belongs to one thread and its splats come in order of depth, so the image does not depend on the number of
threads; gradients are written once per (splat, band) and summed in a fixed order afterwards, so they do not either.

Pixels are blended in blocks of eight along a row. A block's values lie side by side, eight transmittances, then eight
reds and so on, at offsets that LLVM knows to be apart: so the loop over a block becomes one sequence of vector
instructions, 256 bits in float32, without a branch.

Shapes: V splats nearest first, B bands, S (splat, band) pairs; `shapes` and `bounds` are those of `_splat_lists`.
`scratch` [threads, floats] has room for one band's blocks, `scratch_size` floats. Ranks are exact up to 2^24 splats.
"""

from __future__ import annotations

import numpy as np
from numba import carray, njit, types  # pyright: ignore[reportPrivateImportUsage]
from numba.core import cgutils
from numba.extending import intrinsic

from ssa_nerfstudio.rasterization._exponential import exp_negative
from ssa_nerfstudio.rasterization._splat_lists import BLOCK, extent_of_splat, row_of_splat
from ssa_nerfstudio.rasterization.constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN

GRADIENTS = 12
"""Columns of a partial gradient: center x y, |center| x y, conic xx xy yy, opacity, color r g b, depth."""
PLANES = 7
"""Values of a pixel in `scratch`. Forward: transmittance, negative once the pixel is done; red, green, blue, depth;
last. Backward: transmittance in front of the splats walked so far, cotangent of what lies behind the current splat,
cotangents of red, green, blue and depth; last."""


def scratch_size(width: int) -> int:
    """Floats of scratch that a thread needs for images of this width."""
    return TILE * -(-width // BLOCK) * PLANES * BLOCK


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def blend_bands(thread, threads, starts, members, shapes, bounds, colors, scratch, image, transmittance, last):
    """Blend bands thread, thread + threads, ... into image [H, W, 4], transmittance [H, W], last [H, W].

    `last` becomes the number of the band's splats up to the last one that was drawn at the pixel.
    """
    height, width = transmittance.shape
    real = colors.dtype.type
    zero, one = real(0.0), real(1.0)
    alpha_min, alpha_max, transmittance_min = real(ALPHA_MIN), real(ALPHA_MAX), real(TRANSMITTANCE_MIN)
    blocks = (width + BLOCK - 1) // BLOCK
    pixels = scratch[thread]
    live = np.empty((TILE, blocks), np.bool_)
    for band in range(thread, starts.shape[0] - 1, threads):
        top = band * TILE
        bottom = min(top + TILE, height)
        pixels[:] = zero
        live[:] = True
        n_live = (bottom - top) * blocks
        for row in range(bottom - top):
            for block in range(blocks):
                at = (row * blocks + block) * PLANES * BLOCK
                for j in range(min(BLOCK, width - block * BLOCK)):
                    pixels[at + j] = one
        for s in range(starts[band], starts[band + 1]):
            if n_live == 0:
                break
            v = members[s]
            extent = extent_of_splat(shapes, bounds, v)
            narrowness, opacity = real(shapes[v, 3]), real(shapes[v, 7])
            r, g, b, d = colors[v, 0], colors[v, 1], colors[v, 2], colors[v, 3]
            rank = real(s - starts[band] + 1)
            for y in range(max(top, bounds[v, 2]), min(bottom, bounds[v, 3])):
                _, sigma, middle, first, end = row_of_splat(extent, y)
                sigma_row = real(sigma)
                for block in range(first, end):
                    if not live[y - top, block]:
                        continue
                    at = np.uintp(((y - top) * blocks + block) * PLANES * BLOCK)
                    left = real(block * BLOCK - middle)
                    any_live = False
                    for j in range(BLOCK):
                        i = at + np.uintp(j)
                        t = left + real(j)
                        alpha = opacity * exp_negative(-(narrowness * t * t + sigma_row))
                        before = pixels[i]
                        touched = alpha >= alpha_min
                        drawn = min(alpha, alpha_max)
                        after = before * (one - drawn)
                        visible = touched and after > transmittance_min
                        weight = drawn * before if visible else zero
                        pixels[i + np.uintp(1 * BLOCK)] += weight * r
                        pixels[i + np.uintp(2 * BLOCK)] += weight * g
                        pixels[i + np.uintp(3 * BLOCK)] += weight * b
                        pixels[i + np.uintp(4 * BLOCK)] += weight * d
                        if visible:
                            pixels[i + np.uintp(5 * BLOCK)] = rank
                        remaining = after if visible else (-abs(before) if touched else before)
                        pixels[i] = remaining
                        any_live |= remaining > zero
                    if not any_live:
                        live[y - top, block] = False
                        n_live -= 1
        for y in range(top, bottom):
            for block in range(blocks):
                at = ((y - top) * blocks + block) * PLANES * BLOCK
                for j in range(min(BLOCK, width - block * BLOCK)):
                    i, x = at + j, block * BLOCK + j
                    transmittance[y, x] = abs(pixels[i])
                    for channel in range(4):
                        image[y, x, channel] = pixels[i + (1 + channel) * BLOCK]
                    last[y, x] = pixels[i + 5 * BLOCK]


@intrinsic
def _twelve_sums(typing_context, like):
    """Pointer to GRADIENTS x BLOCK numbers of a type on the stack, where LLVM knows that no array overlaps them."""

    def allocate(context, builder, signature, arguments):
        return cgutils.alloca_once(builder, context.get_value_type(like), size=GRADIENTS * BLOCK)

    return types.CPointer(like)(like), allocate


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def backpropagate_bands(
    thread,
    threads,
    starts,
    members,
    slots,
    shapes,
    bounds,
    conics,
    colors,
    transmittance,
    last,
    v_image,
    v_alpha,
    scratch,
    partial,
):
    """Write the gradient of every (splat, band) pair of these bands into partial [S, GRADIENTS].

    Walks the splats of a pixel from the last drawn one to the nearest, so that the transmittance before each is
    recovered by a division by at least 1 - 0.999. `v_image` [H, W, 4] and `v_alpha` [H, W] are the cotangents.
    """
    height, width = transmittance.shape
    real = colors.dtype.type
    zero, one = real(0.0), real(1.0)
    alpha_min, alpha_max = real(ALPHA_MIN), real(ALPHA_MAX)
    blocks = (width + BLOCK - 1) // BLOCK
    pixels = scratch[thread]
    deepest = np.empty((TILE, blocks), np.int64)
    sums = carray(_twelve_sums(zero), GRADIENTS * BLOCK)  # pyright: ignore[reportCallIssue]
    total = np.empty(GRADIENTS, np.float64)
    for band in range(thread, starts.shape[0] - 1, threads):
        top = band * TILE
        bottom = min(top + TILE, height)
        pixels[:] = zero
        ranks = 0
        for y in range(top, bottom):
            for block in range(blocks):
                at = ((y - top) * blocks + block) * PLANES * BLOCK
                most = 0
                for j in range(min(BLOCK, width - block * BLOCK)):
                    i, x = at + j, block * BLOCK + j
                    pixels[i] = transmittance[y, x]
                    pixels[i + BLOCK] = -transmittance[y, x] * v_alpha[y, x]
                    for channel in range(4):
                        pixels[i + (2 + channel) * BLOCK] = v_image[y, x, channel]
                    pixels[i + 6 * BLOCK] = last[y, x]
                    most = max(most, last[y, x])
                deepest[y - top, block] = most
                ranks = max(ranks, most)
        for s in range(starts[band] + ranks - 1, starts[band] - 1, -1):
            v = members[s]
            extent = extent_of_splat(shapes, bounds, v)
            narrowness, opacity = real(shapes[v, 3]), real(shapes[v, 7])
            shear, falloff = shapes[v, 2], shapes[v, 5]
            r, g, b, d = colors[v, 0], colors[v, 1], colors[v, 2], colors[v, 3]
            slope_x, slope_y = conics[v, 1], real(2.0 * falloff)
            rank = s - starts[band] + 1
            sums[:] = zero
            for y in range(max(top, bounds[v, 2]), min(bottom, bounds[v, 3])):
                dy, sigma, middle, first, end = row_of_splat(extent, y)
                down, sigma_row = real(dy), real(sigma)
                for block in range(first, end):
                    if deepest[y - top, block] < rank:
                        continue
                    at = np.uintp(((y - top) * blocks + block) * PLANES * BLOCK)
                    left = real(block * BLOCK - middle)
                    for j in range(BLOCK):
                        k = np.uintp(j)
                        i = at + k
                        t = left + real(j)
                        alpha = opacity * exp_negative(-(narrowness * t * t + sigma_row))
                        visible = (alpha >= alpha_min) & (pixels[i + np.uintp(6 * BLOCK)] >= real(rank))
                        drawn = min(alpha, alpha_max)
                        inverse = one / (one - drawn)
                        before, behind = pixels[i], pixels[i + np.uintp(1 * BLOCK)]
                        ahead = before * inverse
                        weight = drawn * ahead if visible else zero
                        g_r, g_g = pixels[i + np.uintp(2 * BLOCK)], pixels[i + np.uintp(3 * BLOCK)]
                        g_b, g_d = pixels[i + np.uintp(4 * BLOCK)], pixels[i + np.uintp(5 * BLOCK)]
                        cotangent = r * g_r + g * g_g + b * g_b + d * g_d
                        v_drawn = ahead * cotangent - behind * inverse
                        value = alpha * v_drawn if visible and alpha <= alpha_max else zero
                        pixels[i] = ahead if visible else before
                        pixels[i + np.uintp(1 * BLOCK)] = behind + weight * cotangent
                        value_x, value_y = value * t, value * down
                        sums[k] += value
                        sums[k + np.uintp(1 * BLOCK)] += value_x
                        sums[k + np.uintp(2 * BLOCK)] += value_y
                        sums[k + np.uintp(3 * BLOCK)] += value_x * t
                        sums[k + np.uintp(4 * BLOCK)] += value_y * t
                        sums[k + np.uintp(5 * BLOCK)] += value_y * down
                        sums[k + np.uintp(6 * BLOCK)] += abs(value_x)
                        sums[k + np.uintp(7 * BLOCK)] += abs(value * (slope_x * t + slope_y * down))
                        sums[k + np.uintp(8 * BLOCK)] += weight * g_r
                        sums[k + np.uintp(9 * BLOCK)] += weight * g_g
                        sums[k + np.uintp(10 * BLOCK)] += weight * g_b
                        sums[k + np.uintp(11 * BLOCK)] += weight * g_d
            for column in range(GRADIENTS):
                i = column * BLOCK
                low = (float(sums[i]) + sums[i + 1]) + (float(sums[i + 2]) + sums[i + 3])
                high = (float(sums[i + 4]) + sums[i + 5]) + (float(sums[i + 6]) + sums[i + 7])
                total[column] = low + high
            # d sigma = -value, and t = dx + shear dy
            xx, xy = conics[v, 0], conics[v, 1]
            slot = slots[v] + band - bounds[v, 2] // TILE
            partial[slot, 0] = xx * total[1]
            partial[slot, 1] = xy * total[1] + 2.0 * falloff * total[2]
            partial[slot, 2] = xx * total[6]
            partial[slot, 3] = total[7]
            partial[slot, 4] = -0.5 * (total[3] - 2.0 * shear * total[4] + shear * shear * total[5])
            partial[slot, 5] = -(total[4] - shear * total[5])
            partial[slot, 6] = -0.5 * total[5]
            partial[slot, 7] = total[0] / shapes[v, 7]
            for channel in range(4):
                partial[slot, 8 + channel] = total[8 + channel]


@njit(cache=True, nogil=True)
def sum_partials(slots, partial, total):
    """Sum each splat's rows of partial [S, GRADIENTS] into total [V, GRADIENTS], in order of the bands."""
    for v in range(total.shape[0]):
        for column in range(GRADIENTS):
            value = 0.0
            for slot in range(slots[v], slots[v + 1]):
                value += partial[slot, column]
            total[v, column] = value
