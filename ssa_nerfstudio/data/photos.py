"""The image decoder: photos in, as 8-bit RGB, and PNG files out."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps

from ssa_nerfstudio._system.named_pipes import refuse_pipe
from ssa_nerfstudio.errors import InputError

HEIF_SUFFIXES = {".heic", ".heif"}
"""Suffixes of photos that need the package pillow-heif, in lower case."""
UPRIGHT = 1
"""The EXIF orientation of a photo whose pixels are stored as they are shown."""
MAX_PIXELS = 500_000_000
"""Of a photo. The largest cameras have 250 million; a file that states more is broken or hostile."""
_COMPRESSION = 1
"""zlib's fastest: level 6 takes three times as long for files 13 % smaller."""

# Pillow refuses photos of more than 179 million pixels by itself, also where nerfstudio opens them.
Image.MAX_IMAGE_PIXELS = MAX_PIXELS


@contextmanager
def open_photo(path: Path, modes: Collection[str] = ("RGB", "L", "RGBA")) -> Iterator[Image.Image]:
    """Open a photo without decoding it; errors of the block are those of the photo.

    Args:
        path: the file.
        modes: Pillow's modes that are taken.

    Yields:
        The photo, of which only the header has been read.

    Raises:
        InputError: the file is missing or no photo, the block failed to decode it, its pixels are not 8-bit RGB, gray
            or RGBA, or it is HEIC and pillow-heif is missing.
    """
    if path.suffix.lower() in HEIF_SUFFIXES:
        _register_heif(path)
    try:
        refuse_pipe(path)
        with Image.open(path) as image:
            if image.mode not in modes:
                kind = "RGB" if "RGB" in modes else "gray"
                raise InputError(f"{path} is of mode {image.mode}", f"convert it to 8-bit {kind}")
            if image.width * image.height > MAX_PIXELS:
                raise InputError(
                    f"{path} is {image.width} x {image.height}, more than {MAX_PIXELS / 1e6:.0f} megapixels",
                    "reduce it",
                )
            yield image
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist", "put the photo there or remove its frame") from error
    # Pillow's decoders raise whatever a broken file leads them to.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{path} cannot be read as a photo ({error})", "copy it again from its source or remove it"
        ) from error


def load_photo(path: Path, upright: bool = False) -> Image.Image:
    """Decode a photo and keep its EXIF data.

    Args:
        path: the file.
        upright: whether to turn the photo as its EXIF orientation says. nerfstudio ignores the orientation.

    Returns:
        An image of mode RGB, L or RGBA.

    Raises:
        InputError: see `open_photo`.
    """
    with open_photo(path) as image:
        image.load()
        image.getexif()  # read now: some formats need the open file for it
        return ImageOps.exif_transpose(image) if upright else image


def read_photo(
    path: Path, size: tuple[int, int] | None = None, upright: bool = False, alpha: bool = False
) -> np.ndarray:
    """Decode a photo to an array.

    Args:
        path: the file.
        size: expected width and height, pixels, in the orientation that is returned.
        upright: whether to turn the photo as its EXIF orientation says.
        alpha: whether RGBA stays RGBA. Otherwise photos with transparent pixels are refused.

    Returns:
        uint8 [H, W, 3], or [H, W, 4] for RGBA and `alpha`; writable.

    Raises:
        InputError: see `open_photo`; or the size is another, or pixels are transparent.
    """
    image = load_photo(path, upright)
    _check_size(path, image, size)
    if image.mode != "RGBA":
        return np.array(image.convert("RGB"))
    pixels = np.array(image)
    if alpha:
        return pixels
    if pixels[..., 3].min() < 255:
        raise InputError(f"{path} has transparent pixels", "convert it to 8-bit RGB")
    return np.ascontiguousarray(pixels[..., :3])


def check_mask(path: Path, size: tuple[int, int]) -> None:
    """Check that nerfstudio can read a mask: one channel, whose black is ignored, of its photo's size.

    Args:
        path: the file.
        size: the photo's width and height, pixels.

    Raises:
        InputError: it is something else, or see `open_photo`.
    """
    with open_photo(path, modes=("L", "1")) as image:
        image.load()
    _check_size(path, image, size)


def read_gray(path: Path) -> np.ndarray:
    """Decode a photo to luma: uint8 [H, W], in the orientation of its pixels.

    Raises:
        InputError: see `open_photo`.
    """
    with open_photo(path) as image:
        image.draft("L", image.size)  # JPEG: the stored luma itself, which is also faster
        return np.array(image.convert("L"))


def _check_size(path: Path, image: Image.Image, size: tuple[int, int] | None) -> None:
    if size is not None and image.size != size:
        raise InputError(
            f"{path} is {image.width} x {image.height}, expected {size[0]} x {size[1]}",
            "replace it, or correct w and h in transforms.json",
        )


def exif_orientation(image: Image.Image) -> int:
    """EXIF orientation of an open photo, 1 to 8. A PNG is decoded for it."""
    return image.getexif().get(ExifTags.Base.Orientation, UPRIGHT)


def write_photo(path: Path, image: np.ndarray) -> None:
    """Write uint8 [H, W, 3] as PNG; the folder is made where missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, format="PNG", compress_level=_COMPRESSION)


def _register_heif(path: Path) -> None:
    try:
        from pillow_heif import register_heif_opener  # pyright: ignore[reportMissingImports] - optional
    except ImportError as error:
        raise InputError(f"{path} needs a decoder", "pip install pillow-heif, or convert the photos to JPEG") from error
    register_heif_opener()
