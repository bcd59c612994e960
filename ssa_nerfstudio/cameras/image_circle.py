"""The image circle of a fisheye lens: outside of it a photo is black."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

_DARK = 16
"""Gray level up to which a pixel that is so in all photos may lie outside of the circle: noise and stray light."""
_CORNER = 0.03
"""Side of the squares in the frame's corners that are dark, relative to its shorter side."""
_MAX_RESIDUAL = 0.02
"""Median distance of the border from the circle, relative to its radius, up to which it is one."""
_FITS = 5
_PHOTOS = 16
"""Photos in which a circle is looked for: more show no more of its border."""

_Photo = TypeVar("_Photo")


class Circle(NamedTuple):
    """In pixels; (0, 0) is the outer corner of the first pixel."""

    x: float
    y: float
    radius: float

    def coverage(self, height: int, width: int) -> np.ndarray:
        """Share of each pixel that lies inside, with an edge of one pixel: float32 [height, width]."""
        y, x = np.mgrid[:height, :width] + 0.5
        return (self.radius - np.hypot(x - self.x, y - self.y) + 0.5).clip(0, 1).astype(np.float32)


def sampled(photos: Sequence[_Photo]) -> Sequence[_Photo]:
    """At most 16 of a camera's photos, at least 1, or of what names them: evenly spaced."""
    return photos[:: -(-len(photos) // _PHOTOS)]


def brightest(photos: Iterable[np.ndarray]) -> np.ndarray:
    """Each pixel's brightest value in photos uint8 [H, W, 3] of one size, at least one: uint8 [H, W]."""
    peaks = (photo.max(axis=-1) for photo in photos)
    result = next(peaks).copy()
    for peak in peaks:
        np.maximum(result, peak, out=result)
    return result


def image_circle(peak: np.ndarray) -> Circle | None:
    """Find the image circle; where the frame cuts it off, from the arcs that are left.

    Args:
        peak: `brightest` of photos.

    Returns:
        The circle, or None where the corners of the frame show the scene or what is bright is no circle.
    """
    seen = peak > _DARK
    height, width = seen.shape
    side = max(1, round(_CORNER * min(height, width)))
    if any(seen[rows, columns].any() for rows in _ends(side) for columns in _ends(side)) or not seen.any():
        return None
    border = np.concatenate([_ends_of_rows(seen), _ends_of_rows(seen.T)[:, ::-1]])
    if len(border) < 8:
        return None
    residuals = np.zeros(len(border))
    circle = Circle(0, 0, 0)
    for _ in range(_FITS):  # what is dark in all photos, at the border, too, is left out by and by
        near = border[residuals <= 2 * np.median(residuals) + 1]
        # Kasa: x^2 + y^2 = 2 a x + 2 b y + c is linear in the circle.
        system = np.column_stack([2 * near, np.ones(len(near))])
        x, y, c = np.linalg.lstsq(system, np.square(near).sum(axis=1), rcond=None)[0]
        circle = Circle(float(x), float(y), float(np.sqrt(max(c + x * x + y * y, 0))))
        residuals = np.abs(np.hypot(*(border - [x, y]).T) - circle.radius)
    return circle if np.median(residuals) <= max(1, _MAX_RESIDUAL * circle.radius) else None


def _ends(side: int) -> tuple[slice, slice]:
    return slice(None, side), slice(-side, None)


def _ends_of_rows(seen: np.ndarray) -> np.ndarray:
    """Where rows begin and end to be seen inside the frame: positions x, y [N, 2]."""
    rows = np.flatnonzero(seen.any(axis=1))
    first, last = seen[rows].argmax(axis=1), seen.shape[1] - seen[rows, ::-1].argmax(axis=1)
    ends = [
        np.column_stack([x, rows + 0.5])[inside] for x, inside in ((first, first > 0), (last, last < seen.shape[1]))
    ]
    return np.concatenate(ends)
