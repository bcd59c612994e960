"""Numba kernels of the `cpu` rasterizer: splats are blended band by band, a band being one row of 16 x 16 tiles.

A band belongs to one thread and its splats come in order of depth, so the image does not depend on the number of
threads; gradients are written once per (splat, band) and summed in a fixed order afterwards, so they do not either.

Along a row of pixels the exponent of a Gaussian is a parabola, so alpha obeys a recurrence of two multiplications:
alpha(x + 1) = alpha(x) * step(x), step(x + 1) = step(x) * exp(-xx). It replaces an exponential at each pixel, and runs
in float64, where a row's rounding stays near 1e-14. Its roots bound the pixels with alpha >= 1/255.

Shapes: V splats nearest first, B bands, S (splat, band) pairs; `rows` of a band are its pixel rows.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ssa_nerfstudio.rasterization.constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN

GRADIENTS = 12
"""Columns of a partial gradient: center x y, |center| x y, conic xx xy yy, opacity, color r g b, depth."""


@njit(cache=True, nogil=True)
def assign_bands(bounds, n_bands):
    """List each band's splats, nearest first.

    Args:
        bounds: [V, 4] int32, tile-aligned pixel bounds x0, x1, y0, y1 (half open, within the image).

    Returns:
        starts [B + 1] and members [S]: band b draws splats members[starts[b] : starts[b + 1]];
        slots [V + 1]: splat v writes its gradients for its k-th band to row slots[v] + k.
    """
    n = bounds.shape[0]
    slots = np.zeros(n + 1, np.int64)
    starts = np.zeros(n_bands + 1, np.int64)
    for v in range(n):
        first, last = bounds[v, 2] // TILE, (bounds[v, 3] + TILE - 1) // TILE
        if bounds[v, 1] <= bounds[v, 0]:
            last = first
        last = max(first, last)
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


@njit(cache=True, nogil=True, inline="always")
def _row_span(dy, xx, xy, yy, reach, center, x0, x1):
    """Columns [first, last) of a row at height dy above the center where the exponent is at most reach / 2."""
    discriminant = xy * xy * dy * dy - xx * (yy * dy * dy - reach)
    if not discriminant >= 0.0:
        return 0, 0
    root = math.sqrt(discriminant)
    left = center - 0.5 + (-xy * dy - root) / xx
    right = center - 0.5 + (-xy * dy + root) / xx
    first = x0 if left < x0 else (x1 if left > x1 else math.ceil(left))
    last = x1 if right > x1 - 1 else (x0 if right < x0 else math.floor(right) + 1)
    return int(first), int(last)


@njit(cache=True, nogil=True, error_model="numpy")
def blend_bands(
    first_band, step_band, starts, members, centers, conics, opacities, colors, bounds, image, transmittance, last
):
    """Blend bands first_band, first_band + step_band, ... into image [H, W, 4], transmittance [H, W], last [H, W].

    `transmittance` comes in as ones and `image` as zeros; `last` becomes the number of the band's splats up to the
    last one that was drawn at the pixel.
    """
    height, width = transmittance.shape
    done = np.zeros((TILE, width), np.bool_)
    live = np.zeros(TILE, np.int64)
    for band in range(first_band, starts.shape[0] - 1, step_band):
        top = band * TILE
        bottom = min(top + TILE, height)
        done[:] = False
        live[:] = width
        rows_left = bottom - top
        for s in range(starts[band], starts[band + 1]):
            if rows_left == 0:
                break
            v = members[s]
            opacity = float(opacities[v])
            xx, xy, yy = float(conics[v, 0]), float(conics[v, 1]), float(conics[v, 2])
            if not (opacity >= ALPHA_MIN and xx > 0.0):
                continue
            reach = 2.0 * math.log(opacity / ALPHA_MIN)
            cx, cy = float(centers[v, 0]), float(centers[v, 1])
            ratio = math.exp(-xx)
            r, g, b, d = float(colors[v, 0]), float(colors[v, 1]), float(colors[v, 2]), float(colors[v, 3])
            for y in range(max(top, bounds[v, 2]), min(bottom, bounds[v, 3])):
                row = y - top
                if live[row] == 0:
                    continue
                dy = y + 0.5 - cy
                x_first, x_last = _row_span(dy, xx, xy, yy, reach, cx, bounds[v, 0], bounds[v, 1])
                if x_first >= x_last:
                    continue
                dx = x_first + 0.5 - cx
                alpha = opacity * math.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
                step = math.exp(-(xx * (dx + 0.5) + xy * dy))
                for x in range(x_first, x_last):
                    if not done[row, x]:
                        drawn = min(alpha, ALPHA_MAX)
                        before = transmittance[y, x]
                        after = before * (1.0 - drawn)
                        if after <= TRANSMITTANCE_MIN:
                            done[row, x] = True
                            live[row] -= 1
                            if live[row] == 0:
                                rows_left -= 1
                        else:
                            weight = drawn * before
                            image[y, x, 0] += weight * r
                            image[y, x, 1] += weight * g
                            image[y, x, 2] += weight * b
                            image[y, x, 3] += weight * d
                            transmittance[y, x] = after
                            last[y, x] = s - starts[band] + 1
                    alpha *= step
                    step *= ratio


@njit(cache=True, nogil=True, error_model="numpy")
def backpropagate_bands(
    first_band,
    step_band,
    starts,
    members,
    slots,
    centers,
    conics,
    opacities,
    colors,
    bounds,
    transmittance,
    last,
    v_image,
    v_alpha,
    partial,
):
    """Write the gradient of every (splat, band) pair of these bands into partial [S, GRADIENTS].

    Walks the splats of a pixel from the last drawn one to the nearest, so that the transmittance before each is
    recovered by a division by at least 1 - 0.999. `v_image` [H, W, 4] and `v_alpha` [H, W] are the cotangents.
    """
    height, width = transmittance.shape
    before = np.empty((TILE, width), np.float64)  # transmittance in front of the splats walked so far
    behind = np.empty((TILE, width), np.float64)  # cotangent of what lies behind the current splat
    row_last = np.zeros(TILE, np.int64)
    for band in range(first_band, starts.shape[0] - 1, step_band):
        top = band * TILE
        bottom = min(top + TILE, height)
        deepest = 0
        for y in range(top, bottom):
            row = y - top
            row_last[row] = 0
            for x in range(width):
                before[row, x] = transmittance[y, x]
                behind[row, x] = -transmittance[y, x] * v_alpha[y, x]
                row_last[row] = max(row_last[row], last[y, x])
            deepest = max(deepest, row_last[row])
        for s in range(starts[band] + deepest - 1, starts[band] - 1, -1):
            v = members[s]
            opacity = float(opacities[v])
            xx, xy, yy = float(conics[v, 0]), float(conics[v, 1]), float(conics[v, 2])
            if not (opacity >= ALPHA_MIN and xx > 0.0):
                continue
            rank = s - starts[band] + 1
            reach = 2.0 * math.log(opacity / ALPHA_MIN)
            cx, cy = float(centers[v, 0]), float(centers[v, 1])
            ratio = math.exp(-xx)
            r, g, b, d = float(colors[v, 0]), float(colors[v, 1]), float(colors[v, 2]), float(colors[v, 3])
            v_x = v_y = v_abs_x = v_abs_y = v_xx = v_xy = v_yy = v_opacity = v_r = v_g = v_b = v_d = 0.0
            for y in range(max(top, bounds[v, 2]), min(bottom, bounds[v, 3])):
                row = y - top
                if rank > row_last[row]:
                    continue
                dy = y + 0.5 - cy
                x_first, x_last = _row_span(dy, xx, xy, yy, reach, cx, bounds[v, 0], bounds[v, 1])
                if x_first >= x_last:
                    continue
                dx = x_first + 0.5 - cx
                alpha = opacity * math.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
                step = math.exp(-(xx * (dx + 0.5) + xy * dy))
                for x in range(x_first, x_last):
                    if rank <= last[y, x]:
                        drawn = min(alpha, ALPHA_MAX)
                        inverse = 1.0 / (1.0 - drawn)
                        ahead = before[row, x] * inverse
                        weight = drawn * ahead
                        g_r, g_g = float(v_image[y, x, 0]), float(v_image[y, x, 1])
                        g_b, g_d = float(v_image[y, x, 2]), float(v_image[y, x, 3])
                        cotangent = r * g_r + g * g_g + b * g_b + d * g_d
                        v_r += weight * g_r
                        v_g += weight * g_g
                        v_b += weight * g_b
                        v_d += weight * g_d
                        if alpha <= ALPHA_MAX:
                            v_drawn = ahead * cotangent - behind[row, x] * inverse
                            v_opacity += alpha * v_drawn
                            v_sigma = -alpha * v_drawn
                            v_xx += v_sigma * dx * dx
                            v_xy += v_sigma * dx * dy
                            v_yy += v_sigma * dy * dy
                            pixel_x = -v_sigma * (xx * dx + xy * dy)
                            pixel_y = -v_sigma * (xy * dx + yy * dy)
                            v_x += pixel_x
                            v_y += pixel_y
                            v_abs_x += abs(pixel_x)
                            v_abs_y += abs(pixel_y)
                        before[row, x] = ahead
                        behind[row, x] += weight * cotangent
                    alpha *= step
                    step *= ratio
                    dx += 1.0
            slot = slots[v] + band - bounds[v, 2] // TILE
            partial[slot, 0] = v_x
            partial[slot, 1] = v_y
            partial[slot, 2] = v_abs_x
            partial[slot, 3] = v_abs_y
            partial[slot, 4] = 0.5 * v_xx
            partial[slot, 5] = v_xy
            partial[slot, 6] = 0.5 * v_yy
            partial[slot, 7] = v_opacity / opacity
            partial[slot, 8] = v_r
            partial[slot, 9] = v_g
            partial[slot, 10] = v_b
            partial[slot, 11] = v_d


@njit(cache=True, nogil=True)
def sum_partials(slots, partial, total):
    """Sum each splat's rows of partial [S, GRADIENTS] into total [V, GRADIENTS], in order of the bands."""
    for v in range(total.shape[0]):
        for column in range(GRADIENTS):
            value = 0.0
            for slot in range(slots[v], slots[v + 1]):
                value += partial[slot, column]
            total[v, column] = value
