"""L1 + SSIM and its gradient on a CPU: numba, two passes over rows, vectorized along them. See `photometric_loss`."""

from __future__ import annotations

import numpy as np
from numba import njit

from ssa_nerfstudio._system.kernel_threads import on_all_threads

FAST = {"reassoc", "contract", "arcp", "nsz"}
"""The fast-math flags that vectorizing needs, without `nnan` and `ninf`: the loss of a NaN has to be NaN."""


def value_and_gradient(
    prediction: np.ndarray, target: np.ndarray, ssim_weight: float, window: np.ndarray
) -> tuple[float, np.ndarray]:
    """Compute the loss and its gradient with respect to the prediction.

    Args:
        prediction, target: [C, H, W], contiguous, one float dtype.
        ssim_weight: w in [0, 1].
        window: [K] weights that sum to 1, symmetric, of the images' dtype.

    Returns:
        The loss, summed in the same order for any number of threads, and the gradient [C, H, W].
    """
    channels, height, width = prediction.shape
    rows, columns = height - len(window) + 1, width - len(window) + 1
    slopes = np.empty((3, channels, rows, columns), prediction.dtype)
    similarity = np.zeros((channels, rows))
    difference = np.zeros((channels, height))
    gradient = np.empty_like(prediction)
    l1_scale = (1.0 - ssim_weight) / prediction.size
    ssim_scale = ssim_weight / (channels * rows * columns)
    on_all_threads(_similarity_rows, prediction, target, window, slopes, similarity)
    on_all_threads(_gradient_rows, prediction, target, window, slopes, l1_scale, -ssim_scale, gradient, difference)
    return ssim_weight - ssim_scale * float(similarity.sum()) + l1_scale * float(difference.sum()), gradient


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def _similarity_rows(thread, threads, x, y, window, slopes, similarity):
    """Fill slopes with dS/d(mean x), dS/dE[x^2 + y^2], dS/dE[xy], and similarity with S summed along rows."""
    channels, rows, columns = similarity.shape[0], similarity.shape[1], slopes.shape[3]
    width = x.shape[2]
    size = window.shape[0]
    c1, c2 = 0.01**2, 0.03**2
    sums = np.empty((4, width), x.dtype)
    a, b = np.empty(columns, x.dtype), np.empty(columns, x.dtype)
    q, p = np.empty(columns, x.dtype), np.empty(columns, x.dtype)
    for c in range(channels):
        for row in range(rows * thread // threads, rows * (thread + 1) // threads):
            sums[:] = 0
            for k in range(size):
                weight = window[k]
                for j in range(width):
                    u, v = x[c, row + k, j], y[c, row + k, j]
                    sums[0, j] += weight * u
                    sums[1, j] += weight * v
                    sums[2, j] += weight * (u * u + v * v)
                    sums[3, j] += weight * (u * v)
            a[:] = 0
            b[:] = 0
            q[:] = 0
            p[:] = 0
            for k in range(size):
                weight = window[k]
                for j in range(columns):
                    a[j] += weight * sums[0, j + k]
                    b[j] += weight * sums[1, j + k]
                    q[j] += weight * sums[2, j + k]
                    p[j] += weight * sums[3, j + k]
            total = 0.0
            for j in range(columns):
                squares = a[j] * a[j] + b[j] * b[j]
                product = a[j] * b[j]
                n1, d1 = 2 * product + c1, squares + c1
                n2, d2 = 2 * (p[j] - product) + c2, q[j] - squares + c2
                inverse = 1 / (d1 * d2)
                s = n1 * n2 * inverse
                total += s
                slopes[0, c, row, j] = 2 * b[j] * (n2 - n1) * inverse + 2 * a[j] * s * (d1 - d2) * inverse
                slopes[1, c, row, j] = -s * d1 * inverse
                slopes[2, c, row, j] = 2 * n1 * inverse
            similarity[c, row] = total


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def _gradient_rows(thread, threads, x, y, window, slopes, l1_scale, ssim_scale, gradient, difference):
    """Spread the slopes back over each window (the transposed blur) and add the L1 term; difference sums |x - y|."""
    channels, height, width = x.shape
    rows, columns = slopes.shape[2], slopes.shape[3]
    size = window.shape[0]
    padded = np.empty((3, columns + 2 * size - 2), x.dtype)
    spread = np.empty((3, width), x.dtype)
    for c in range(channels):
        for row in range(height * thread // threads, height * (thread + 1) // threads):
            padded[:] = 0
            for k in range(size):
                source = row - k
                if 0 <= source < rows:
                    weight = window[k]
                    for j in range(columns):
                        padded[0, j + size - 1] += weight * slopes[0, c, source, j]
                        padded[1, j + size - 1] += weight * slopes[1, c, source, j]
                        padded[2, j + size - 1] += weight * slopes[2, c, source, j]
            spread[:] = 0
            for k in range(size):
                weight = window[k]
                for j in range(width):
                    spread[0, j] += weight * padded[0, j + k]
                    spread[1, j] += weight * padded[1, j + k]
                    spread[2, j] += weight * padded[2, j + k]
            total = 0.0
            for j in range(width):
                u, v = x[c, row, j], y[c, row, j]
                total += abs(u - v)
                sign = 1.0 if u > v else (-1.0 if u < v else 0.0)
                gradient[c, row, j] = l1_scale * sign + ssim_scale * (
                    spread[0, j] + 2 * u * spread[1, j] + v * spread[2, j]
                )
            difference[c, row] = total
