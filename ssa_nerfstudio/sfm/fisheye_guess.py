"""Where the estimate of a fisheye lens starts. COLMAP's own guess, 45 degrees, matches no two photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ssa_nerfstudio.cameras.image_circle import brightest, image_circle, sampled
from ssa_nerfstudio.data.photos import read_photo

_FRAME_ANGLE = 130.0
"""Degrees that the longer side of a frame without an image circle is taken for: action cameras have 110 to 150."""


def fisheye_guess(photos: Sequence[Path]) -> list[float]:
    """fx, fy, cx, cy, k1 to k4 of an ideal lens, whose image circle, where there is one, is 180 degrees wide.

    Args:
        photos: of one camera, at least one.

    Raises:
        InputError: a photo cannot be decoded.
    """
    peak = brightest(read_photo(path) for path in sampled(photos))
    circle, (height, width) = image_circle(peak), peak.shape
    if circle is not None:
        focal, middle = circle.radius / (np.pi / 2), (circle.x, circle.y)
    else:
        focal, middle = max(width, height) / np.radians(_FRAME_ANGLE), (width / 2, height / 2)
    return [focal, focal, *middle, 0.0, 0.0, 0.0, 0.0]
