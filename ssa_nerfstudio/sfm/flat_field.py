"""Blind flat-field correction: divides photos by their static factor, so that features are found on the scene.

Weiss 2001, Deriving intrinsic images from image sequences. A photo is the product of a static factor and the scene; in
the logarithm it is their sum. Gradients of a scene that moves through the frame are sparse and of either sign: at each
pixel their median over the photos is 0, so the median of the photos' gradients is the gradient of the static factor. A
Poisson equation integrates it. The result is exact where the artifact only darkens (dirt, glass, shadows), and flat
where it is opaque.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import PIL.Image

from ssa_nerfstudio.data.photos import load_photo, read_gray
from ssa_nerfstudio.data.writing import staged_file
from ssa_nerfstudio.evidence.poisson import add_divergence, solve_poisson

MIN_PHOTOS = 8
"""With fewer photos, static structure cannot be distinguished from scene structure at the same place."""
_MAX_PHOTOS = 64
_DARK = 8.0
"""Added to 8-bit values before the logarithm: darker differences are noise."""
_NOISE_ERRORS = 1.0
"""Standard errors up to which a median gradient counts as 0."""
_CERTAIN_ERRORS = 5.0
"""Standard errors from which a gradient is certain, among millions and with errors estimated from eight photos."""
_MIN_SHARE = 0.005
"""Share of certain gradients from which flattening is worth its time."""
_MAX_LOG_GAIN = 1.4
"""Natural logarithm of the gain: beyond a factor of 4 it would amplify little but noise."""
_COARSE_SCALE = 12
"""Variations wider than a 12th of the shorter side are left in: no feature depends on them."""
_ROWS = 32


def static_factor(photos: Sequence[Path], max_size: int) -> np.ndarray | None:
    """Estimate the static factor of photos of one size, up to a constant and slow variations.

    Reads at most 64 photos, evenly spaced, in gray; memory is proportional to their number and size.

    Args:
        photos: files, at least 1.
        max_size: longest side to work at, pixels.

    Returns:
        Its natural logarithm, float32 [H, W], smaller than the photos where they exceed `max_size`; None where nothing
        is static.
    """
    step = max(1, -(-len(photos) // _MAX_PHOTOS))
    stack = np.stack([_gray(path, max_size) for path in photos[::step]])
    _, height, width = stack.shape
    divergence = np.zeros((height, width), dtype=np.float32)
    certain = 0
    for top in range(0, height, _ROWS):
        rows = np.log(stack[:, top : top + _ROWS + 1] + np.float32(_DARK))
        kept = min(_ROWS, height - top)
        across, certain_across = _typical(np.diff(rows[:, :kept], axis=2))
        down, certain_down = _typical(np.diff(rows, axis=1))
        certain += certain_across + certain_down
        add_divergence(divergence[top:], across, down)
    if certain < _MIN_SHARE * 2 * height * width:
        return None
    factor = solve_poisson(divergence)
    return factor - cv2.GaussianBlur(factor, (0, 0), min(height, width) / _COARSE_SCALE)


def flattened(photo: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Divide a photo by the static factor.

    Args:
        photo: uint8 [H, W, channels].
        factor: natural logarithm, [h, w]; scaled to the photo's size.

    Returns:
        uint8 [H, W, channels].
    """
    if factor.shape != photo.shape[:2]:
        factor = cv2.resize(factor, (photo.shape[1], photo.shape[0]), interpolation=cv2.INTER_LINEAR)
    gain = np.exp(np.clip(-factor, -_MAX_LOG_GAIN, _MAX_LOG_GAIN))[..., None]
    return np.rint(((photo + np.float32(_DARK)) * gain - _DARK).clip(0, 255)).astype(np.uint8)


def write_flattened(source: Path, target: Path, factor: np.ndarray) -> None:
    """Write a copy of a photo without the static factor, with its EXIF data: COLMAP reads the focal length there.

    Args:
        source: JPEG or PNG.
        target: file to write, of the same suffix.
        factor: natural logarithm, [h, w].
    """
    image = load_photo(source)
    photo = PIL.Image.fromarray(flattened(np.asarray(image.convert("RGB")), factor))
    kind = "PNG" if target.suffix == ".png" else "JPEG"
    with staged_file(target) as part:
        photo.save(part, kind, quality=95, subsampling=0, compress_level=1, exif=image.getexif())


def _gray(path: Path, max_size: int) -> np.ndarray:
    gray = read_gray(path)
    scale = max_size / max(gray.shape)
    if scale < 1:
        size = max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return gray


def _typical(gradients: np.ndarray) -> tuple[np.ndarray, int]:
    """Median over the photos [N, ...], shrunk to 0 within its standard error, and the number of certain gradients."""
    count = len(gradients)
    low, middle, high = count // 4, count // 2, (3 * count) // 4
    ordered = np.partition(gradients, (low, middle, high), axis=0)
    median = ordered[middle]
    # Normal distribution: deviation = quartile range / 1.349, standard error of the median = 1.253 deviation / sqrt(N).
    error = (ordered[high] - ordered[low]) * (1.253 / 1.349 / np.sqrt(count))
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = 1 - np.square(_NOISE_ERRORS * error / median)
    certain = int((np.abs(median) > _CERTAIN_ERRORS * error).sum())
    return np.where(median == 0, 0, median * weight.clip(0, None)), certain
