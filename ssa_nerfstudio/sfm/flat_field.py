"""Takes what is the same in all photos out of them, so that features are the scene's: flat-field correction, blind.

Weiss 2001, Deriving intrinsic images from image sequences: a photo is the product of what is static and what is not, in
the logarithm a sum. Gradients of a scene that moves through the frame are sparse and of either sign, so that at each
pixel their median over the photos is 0, and the median of the photos' gradients is the static factor's. A Poisson
equation gives the factor back. It is exact for what only darkens (dirt, glass, shadows), and makes what is opaque flat.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import PIL.Image

from ssa_nerfstudio.evidence.poisson import add_divergence, integrated

LEAST_PHOTOS = 8
"""Fewer photos do not tell what is static from what happens to lie at the same place."""
_MOST_PHOTOS = 64
_DARK = 8.0
"""Added to 8-bit values before the logarithm: darker differences are noise."""
_CHANCE = 1.0
"""Standard errors below which a median gradient counts as 0."""
_CERTAIN = 5.0
"""Standard errors from which on it is no chance, even among millions and with errors estimated from eight photos."""
_LEAST_SHARE = 0.005
"""Share of such gradients from which on photos are worth flattening."""
_LARGEST_GAIN = 1.4
"""Natural logarithm; beyond a factor of 4 nothing but noise would come back."""
_COARSEST = 12
"""What varies more slowly than over a 12th of the shorter side is left in: no feature depends on it."""
_ROWS = 32


def static_factor(photos: Sequence[Path], max_size: int) -> np.ndarray | None:
    """The static factor of photos of one size, up to a constant and slow variations; None where nothing is static.

    Reads at most 64 of them, evenly spaced, in gray; memory is proportional to their number and size.

    Args:
        photos: files, at least 1.
        max_size: longest side to work at, pixels.

    Returns:
        Its natural logarithm, float32 [H, W], smaller than the photos where they exceed `max_size`.
    """
    step = max(1, -(-len(photos) // _MOST_PHOTOS))
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
    if certain < _LEAST_SHARE * 2 * height * width:
        return None
    factor = integrated(divergence)
    return factor - cv2.GaussianBlur(factor, (0, 0), min(height, width) / _COARSEST)


def flattened(photo: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """A photo without the static factor.

    Args:
        photo: uint8 [H, W, channels].
        factor: natural logarithm, [h, w]; scaled to the photo's size.

    Returns:
        uint8 [H, W, channels].
    """
    if factor.shape != photo.shape[:2]:
        factor = cv2.resize(factor, (photo.shape[1], photo.shape[0]), interpolation=cv2.INTER_LINEAR)
    gain = np.exp(np.clip(-factor, -_LARGEST_GAIN, _LARGEST_GAIN))[..., None]
    return np.rint(((photo + np.float32(_DARK)) * gain - _DARK).clip(0, 255)).astype(np.uint8)


def write_flattened(source: Path, target: Path, factor: np.ndarray) -> None:
    """Stores a photo without the static factor [h, w]; where it is JPEG, with the EXIF data of the focal length."""
    with PIL.Image.open(source) as image:
        exif = image.getexif()
        photo = PIL.Image.fromarray(flattened(np.asarray(image.convert("RGB")), factor))
    part = target.with_name(f".{target.name}")
    photo.save(part, quality=95, subsampling=0, compress_level=1, exif=exif)
    part.replace(target)


def _gray(path: Path, max_size: int) -> np.ndarray:
    # Not turned: a photo's frame is that of its pixels.
    gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    scale = max_size / max(gray.shape)
    if scale < 1:
        size = max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return gray


def _typical(gradients: np.ndarray) -> tuple[np.ndarray, int]:
    """Median over the photos [N, ...], shrunk to 0 where it is within its standard error; how many are no chance."""
    count = len(gradients)
    low, middle, high = count // 4, count // 2, (3 * count) // 4
    ordered = np.partition(gradients, (low, middle, high), axis=0)
    median = ordered[middle]
    # Normal distribution: deviation = quartile range / 1.349, standard error of the median = 1.253 deviation / sqrt(N).
    error = (ordered[high] - ordered[low]) * (1.253 / 1.349 / np.sqrt(count))
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = 1 - np.square(_CHANCE * error / median)
    certain = int((np.abs(median) > _CERTAIN * error).sum())
    return np.where(median == 0, 0, median * weight.clip(0, None)), certain
