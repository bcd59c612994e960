"""Masks for feature extraction: read from a file, checked, widened."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ssa_nerfstudio._system.named_pipes import refuse_pipe
from ssa_nerfstudio.errors import InputError

_MIN_USED = 0.05
"""Share of the frame that a mask has to leave: less is a mask of the other polarity, or of no use."""
_MARGIN = 0.01
"""Widening of the masked part, relative to the longer side: descriptors extend beyond their keypoint."""


def read_mask(path: Path, width: int, height: int, inverted: bool = False) -> np.ndarray:
    """Read a mask in the polarity of COLMAP and nerfstudio: black (0) is ignored, all else is used.

    Args:
        path: a picture of the raw frame's shape; one of another size is scaled, nearest neighbor.
        width, height: of the photos, pixels.
        inverted: whether white marks the artifact instead.

    Returns:
        bool [height, width], True where photos are used.

    Raises:
        InputError: it cannot be read, is of another shape, or leaves less than 5 % of the frame.
    """
    try:
        refuse_pipe(path)
        with Image.open(path) as image:
            gray = np.asarray(image.convert("L"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{path} cannot be read as a mask ({error})", "give a picture, black where to ignore"
        ) from error
    # A mask learned at a reduced size has rounded sides.
    if abs(gray.shape[1] * height - gray.shape[0] * width) > max(width, height):
        raise InputError(
            f"{path} is {gray.shape[1]} x {gray.shape[0]}, the photos are {width} x {height}",
            "give a mask of the raw frame",
        )
    used = (gray > 0) != inverted
    if used.shape != (height, width):
        used = cv2.resize(used.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return checked(used, str(path))


def checked(used: np.ndarray, name: str) -> np.ndarray:
    """Return the mask if it leaves enough of the frame.

    Args:
        used: bool [H, W], True where photos are used.
        name: what the message calls it.

    Raises:
        InputError: it leaves less than 5 % of the frame.
    """
    if used.mean() < _MIN_USED:
        raise InputError(
            f"{name} leaves {used.mean():.1%} of the frame: black is ignored",
            "invert the mask if white marks the artifact",
        )
    return used


def widened(used: np.ndarray) -> np.ndarray:
    """Widen the masked part by 1 % of the longer side, so that descriptors do not extend into it."""
    margin = max(1, round(_MARGIN * max(used.shape)))
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    return cv2.erode(used.astype(np.uint8), element) > 0  # whose default is that outside the frame nothing is masked
