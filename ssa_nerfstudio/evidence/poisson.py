"""Integration of gradients to an image: Poisson's equation, solved by a cosine transform."""

from __future__ import annotations

import numpy as np
import scipy.fft


def divergence(across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Divergence [h, w] of differences between neighbors.

    Args:
        across: from left to right, [h, w - 1].
        down: from top to bottom, [h - 1, w].
    """
    total = np.zeros((across.shape[0], down.shape[1]), np.result_type(across, down))
    add_divergence(total, across, down)
    return total


def add_divergence(total: np.ndarray, across: np.ndarray, down: np.ndarray) -> None:
    """Add a divergence in place, for images that are processed in bands of rows.

    Args:
        total: rows of the sum from the band's first on, [at least n, w].
        across: differences within the band's rows, [n, w - 1].
        down: differences from the band's rows to the next ones, [n or n - 1, w].
    """
    total[: len(across), :-1] += across
    total[: len(across), 1:] -= across
    total[: len(down)] += down
    total[1 : 1 + len(down)] -= down


def solve_poisson(divergence: np.ndarray) -> np.ndarray:
    """Solve Poisson's equation: the image of mean 0 whose differences are nearest, in least squares, to the given ones.

    Neumann boundary: no flux through the border.

    Args:
        divergence: of the differences, [h, w].

    Returns:
        [h, w].
    """
    height, width = divergence.shape
    spectrum = np.asarray(scipy.fft.dctn(divergence, norm="ortho"))
    y, x = (2 * np.cos(np.pi * np.arange(side, dtype=spectrum.dtype) / side) - 2 for side in (height, width))
    eigenvalues = y[:, None] + x
    eigenvalues[0, 0] = 1
    spectrum /= eigenvalues
    spectrum[0, 0] = 0
    return np.asarray(scipy.fft.idctn(spectrum, norm="ortho"))
