"""Photos in and out: 8-bit RGB, decoded and encoded by Pillow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from ssa_nerfstudio.errors import InputError

_COMPRESSION = 1
"""zlib's fastest: level 6 takes three times as long for files 13 % smaller."""


def read_photo(path: Path, width: int, height: int) -> np.ndarray:
    """Decodes a photo, ignoring EXIF orientation as nerfstudio does.

    Args:
        path: an image file of 8-bit RGB or gray, or RGBA without transparent pixels.
        width, height: what transforms.json says it is, pixels.

    Returns:
        uint8 [height, width, 3].

    Raises:
        InputError: the file cannot be decoded, or its kind or size is another.
    """
    try:
        with Image.open(path) as image:
            image.load()
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{path} cannot be read as a photo ({error})", "copy it again from its source or remove its frame"
        ) from error
    if image.size != (width, height):
        raise InputError(
            f"{path} is {image.width} x {image.height}, transforms.json says {width} x {height}", "mend w and h there"
        )
    if image.mode not in ("RGB", "L", "RGBA") or (image.mode == "RGBA" and image.getextrema()[3][0] < 255):
        kind = "has transparent pixels" if image.mode == "RGBA" else f"is of mode {image.mode}"
        raise InputError(f"{path} {kind}", "convert it to 8-bit RGB")
    return np.asarray(image.convert("RGB"))


def write_photo(path: Path, image: np.ndarray) -> None:
    """Stores uint8 [H, W, 3] as PNG; the folder is made where missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, format="PNG", compress_level=_COMPRESSION)
