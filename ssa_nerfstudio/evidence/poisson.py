"""An image from its gradients: Poisson's equation, solved by a cosine transform."""

from __future__ import annotations

import numpy as np
import scipy.fft


def divergence(across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Of differences between neighbors: [h, w - 1] from left to right and [h - 1, w] downwards. [h, w]."""
    total = np.zeros((across.shape[0], down.shape[1]), np.result_type(across, down))
    add_divergence(total, across, down)
    return total


def add_divergence(total: np.ndarray, across: np.ndarray, down: np.ndarray) -> None:
    """Add it to rows [h + 1 or fewer, w], of which `across` and `down` are the first: images by bands of rows."""
    total[: len(across), :-1] += across
    total[: len(across), 1:] -= across
    total[: len(down)] += down
    total[1 : 1 + len(down)] -= down


def integrated(divergence: np.ndarray) -> np.ndarray:
    """The image [h, w] of mean 0 whose differences are nearest to those of a divergence, in least squares.

    Without flux through the border: the differences there are free.
    """
    height, width = divergence.shape
    spectrum = np.asarray(scipy.fft.dctn(divergence, norm="ortho"))
    y, x = (2 * np.cos(np.pi * np.arange(side, dtype=spectrum.dtype) / side) - 2 for side in (height, width))
    eigenvalues = y[:, None] + x
    eigenvalues[0, 0] = 1
    spectrum /= eigenvalues
    spectrum[0, 0] = 0
    return np.asarray(scipy.fft.idctn(spectrum, norm="ortho"))
