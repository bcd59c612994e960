"""What effects that draw soft-edged shapes share: pixel positions, coverage, and variation from view to view."""

from __future__ import annotations

import numpy as np


def pixel_centers(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions of pixel centers, x [1, width] rightwards and y [height, 1] downwards, from the upper left corner."""
    return np.arange(width)[None, :] + 0.5, np.arange(height)[:, None] + 0.5


def edge_width(fraction: float, length: float) -> float:
    """Width of a soft edge, pixels: a fraction of a length, at least the pixel that anti-aliasing needs."""
    return max(1.0, fraction * length)


def coverage(distance: np.ndarray) -> np.ndarray:
    """Share of each pixel that a shape covers, in [0, 1].

    Args:
        distance: signed distance to the outline in widths of its edge, negative inside.
    """
    return np.clip(0.5 - distance, 0, 1)


def clipped_normal(rng: np.random.Generator, count: int, max_deviation: float) -> np.ndarray:
    """Standard normal draws [count], clipped so that nothing leaves the rectangle that an effect may change."""
    return np.clip(rng.standard_normal(count), -max_deviation, max_deviation)
