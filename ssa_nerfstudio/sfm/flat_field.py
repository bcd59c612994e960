"""Blind flat-field correction: takes the static factor out of photos, so that features are found on the scene.

An artifact of gray value c that lets T of the scene S through makes I = T S + (1 - T) c of it: around c, the photo
I - c = T (S - c) is the product of a static factor and the scene. c = 0 is Weiss 2001, Deriving intrinsic images from
image sequences: what only darkens (shadows, thin dirt). Mud adds light of its own to what is dark behind it.

Relative gradients of a scene that moves through the frame are sparse and of either sign: at each pixel their median
over the photos, weighted by |I - c|, is the relative gradient of T. A Poisson equation integrates it. c is the value
that leaves the least of the photos' gradients, in absolute values. The result is flat where the artifact is opaque.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
_LEVELS = (*range(-8, 257, 32), 1000)
"""Gray values of the artifact that are tried first. -8 where it only darkens: 0 would magnify the noise of what is
dark. Far beyond white where it adds light and takes none."""
_FINER_STEPS = (16, 8, 4)
_BANDS = 16
"""Pairs of rows, evenly spaced, on which gray values are tried."""
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
_MAX_RELATIVE = 1.9
"""Of a difference to the mean of two neighbors; beyond 2 they lie on either side of the artifact's gray value."""


@dataclass(frozen=True)
class StaticFactor:
    """What multiplies the difference between the scene and the artifact's gray value."""

    level: float
    """The artifact's gray value, 0 to 255, or beyond."""
    log: np.ndarray
    """Natural logarithm of the factor, float32 [H, W], up to a constant and slow variations."""


def static_factor(photos: Sequence[Path], max_size: int) -> StaticFactor | None:
    """Estimate the static factor of photos of one size.

    Reads at most 64 photos, evenly spaced, in gray; memory is proportional to their number and size.

    Args:
        photos: files, at least 1.
        max_size: longest side to work at, pixels.

    Returns:
        The factor, smaller than the photos where they exceed `max_size`; None where nothing is static.
    """
    step = max(1, -(-len(photos) // _MAX_PHOTOS))
    stack = np.stack([_gray(path, max_size) for path in photos[::step]])
    level = _artifact_level(stack)
    _, height, width = stack.shape
    divergence = np.zeros((height, width), dtype=np.float32)
    certain = 0
    for top in range(0, height, _ROWS):
        rows = stack[:, top : top + _ROWS + 1] - np.float32(level)
        kept = min(_ROWS, height - top)
        across, certain_across = _log_gradient(*_relative(rows[:, :kept, :-1], rows[:, :kept, 1:]))
        down, certain_down = _log_gradient(*_relative(rows[:, :-1], rows[:, 1:]))
        certain += certain_across + certain_down
        add_divergence(divergence[top:], across, down)
    if certain < _MIN_SHARE * 2 * height * width:
        return None
    factor = solve_poisson(divergence)
    return StaticFactor(level, factor - cv2.GaussianBlur(factor, (0, 0), min(height, width) / _COARSE_SCALE))


def flattened(gray: np.ndarray, factor: StaticFactor) -> np.ndarray:
    """Take the static factor out of a photo.

    Args:
        gray: luma, uint8 [H, W].
        factor: scaled to the photo's size.

    Returns:
        uint8 [H, W].
    """
    log = factor.log
    if log.shape != gray.shape:
        log = cv2.resize(log, (gray.shape[1], gray.shape[0]), interpolation=cv2.INTER_LINEAR)
    gain = np.exp(np.clip(-log, -_MAX_LOG_GAIN, _MAX_LOG_GAIN))
    level = np.float32(factor.level)
    return np.rint(((gray - level) * gain + level).clip(0, 255)).astype(np.uint8)


def write_flattened(
    files: Sequence[Path], stretches: Sequence[slice], folder: Path, max_size: int, advance: Callable[[int], None]
) -> bool:
    """Write copies of photos, in gray as features are found, without the static factor of their stretch.

    Photos of no stretch, of one that is too short, or of one without a static factor are copied as they are.

    Args:
        files: JPEG or PNG, of one size.
        stretches: parts of the files with an artifact that does not change in them.
        folder: to write to; made, if anything has to be flattened.
        max_size: see `static_factor`.
        advance: called with the number of photos written.

    Returns:
        Whether anything was written.
    """
    factors: dict[Path, StaticFactor] = {}
    for part in (files[stretch] for stretch in stretches):
        if len(part) >= MIN_PHOTOS and (factor := static_factor(part, max_size)) is not None:
            factors |= dict.fromkeys(part, factor)
    if not factors:
        return False
    folder.mkdir(exist_ok=True)
    for number, file in enumerate(files, 1):
        if file in factors:
            _write(file, folder / file.name, factors[file])
        else:
            shutil.copyfile(file, folder / file.name)
        advance(number)
    return True


def _write(source: Path, target: Path, factor: StaticFactor) -> None:
    """With the photo's EXIF data: COLMAP reads the focal length there."""
    image = load_photo(source)
    photo = PIL.Image.fromarray(flattened(np.asarray(image.convert("L")), factor))
    kind = "PNG" if target.suffix == ".png" else "JPEG"
    with staged_file(target) as part:
        photo.save(part, kind, quality=95, compress_level=1, exif=image.getexif())


def _gray(path: Path, max_size: int) -> np.ndarray:
    gray = read_gray(path)
    scale = max_size / max(gray.shape)
    if scale < 1:
        size = max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return gray


def _artifact_level(stack: np.ndarray) -> float:
    """The gray value around which a static factor explains most of photos uint8 [N, H, W]."""
    tops = np.linspace(0, max(0, stack.shape[1] - 2), _BANDS).round().astype(int)
    above, below = stack[:, tops].astype(np.float32), stack[:, (tops + 1).clip(0, stack.shape[1] - 1)]
    pairs = [(above, below.astype(np.float32)), (above[:, :, :-1], above[:, :, 1:])]

    def unexplained(level: float) -> float:
        total = 0.0
        for one, other in pairs:
            relative, weight = _relative(one - np.float32(level), other - np.float32(level))
            median, _ = _weighted_median(relative, weight)
            total += float((np.abs(relative - median) * weight).mean())
        return total

    left = {level: unexplained(level) for level in _LEVELS}
    for step in _FINER_STEPS:
        best = min(left, key=lambda level: left[level])
        left |= {level: unexplained(level) for level in (best - step, best + step) if level >= _LEVELS[0]}
    return min(left, key=lambda level: left[level])


def _relative(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Differences of neighbors relative to their mean, and its absolute value; 0 where that is 0."""
    mean = (one + other) / 2
    return np.divide(other - one, mean, out=np.zeros_like(mean), where=mean != 0), np.abs(mean)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median over the photos [N, ...], and its standard error."""
    order = np.argsort(values, axis=0)
    values, weights = np.take_along_axis(values, order, axis=0), np.take_along_axis(weights, order, axis=0)
    below = np.cumsum(weights, axis=0)
    low, median, high = (
        np.take_along_axis(values, (below < share * below[-1]).sum(axis=0, keepdims=True), axis=0)[0]
        for share in (0.25, 0.5, 0.75)
    )
    # Normal distribution: deviation = quartile range / 1.349, standard error of the median = 1.253 deviation / sqrt(N),
    # and of N photos with weights so many count.
    counted = np.square(below[-1]) / np.maximum(np.square(weights).sum(axis=0), 1e-9)
    return median, (high - low) * (1.253 / 1.349) / np.sqrt(np.maximum(counted, 1))


def _log_gradient(relative: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, int]:
    """Gradient of the factor's logarithm, 0 within its standard error, and the number of certain ones.

    Args:
        relative, weights: from `_relative`, [N, h, w].
    """
    median, error = _weighted_median(relative, weights)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = 1 - np.square(_NOISE_ERRORS * error / median)
    certain = int((np.abs(median) > _CERTAIN_ERRORS * error).sum())
    shrunk = np.where(median == 0, 0, median * weight.clip(0, None)).clip(-_MAX_RELATIVE, _MAX_RELATIVE)
    return 2 * np.arctanh(shrunk / 2), certain
