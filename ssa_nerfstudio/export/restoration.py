"""Photos restored where the artifact lets light through: C = (I - B) / T, which is (I - A W) / (1 - A)."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ssa_nerfstudio.data.photos import open_photo, read_photo, write_photo
from ssa_nerfstudio.data.sources import PHOTO_SUFFIXES
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers

MIN_TRANSMITTANCE = 0.05
"""Pixels of less transmittance in any channel are not recovered: an error of one gray level would become twenty. The
same holds where the artifact adds more than 0.95 of white."""
MAX_ASPECT_DIFFERENCE = 0.005
"""Relative difference of aspect up to which photos count as the training photos at another resolution."""


@dataclass(frozen=True)
class Recovery:
    """Statistics of one restored photo."""

    path: Path
    """Relative to the folder of photos."""
    hidden: float
    """Fraction of pixels that were not recovered and are black."""
    implausible: float
    """Fraction of recovered pixels that are darker than black or brighter than white by more than two gray levels."""
    clipped: float
    """Fraction of pixels that are lower bounds: added light saturated the photo."""


def recoverable(layers: ArtifactLayers) -> np.ndarray:
    """Pixels in which an artifact leaves enough of the scene (`MIN_TRANSMITTANCE`), bool [H, W]."""
    return np.minimum(layers.transmittance, 1 - layers.addition).min(axis=-1) >= MIN_TRANSMITTANCE


def clipped(photo: np.ndarray, layers: ArtifactLayers) -> np.ndarray:
    """Pixels of a photo uint8 [H, W, 3] that added light may have saturated, bool [H, W]: I = clip(T C + B).

    An alpha-blended artifact, T = 1 - A and B = A W, never saturates a photo.
    """
    beyond = layers.transmittance + layers.addition > 1 + 0.5 / 255
    return ((photo == 255) & beyond).any(axis=-1)


def restore(photo: np.ndarray, layers: ArtifactLayers) -> tuple[np.ndarray, np.ndarray, float]:
    """Remove an artifact from a photo.

    Args:
        photo: uint8 [H, W, 3].
        layers: of the photo's frame and size.

    Returns:
        The photo uint8 [H, W, 3], black where not recovered; the recovered pixels, bool [H, W]; and the fraction of
        them that is implausible.
    """
    seen = recoverable(layers)
    scene = photo - np.float32(255) * layers.addition
    scene /= np.maximum(layers.transmittance, np.float32(MIN_TRANSMITTANCE))
    wrong = ((scene < -2) | (scene > 257)).any(axis=-1) & seen
    scene[~seen] = 0
    return np.rint(scene).clip(0, 255).astype(np.uint8), seen, float(wrong.sum() / max(1, seen.sum()))


def find_photos(folder: Path) -> list[Path]:
    """Find the photos in a folder and its subfolders, sorted.

    Raises:
        InputError: there are none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder", "choose the folder of the photos")
    photos = sorted(path for path in folder.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
    if not photos:
        suffixes = ", ".join(sorted(PHOTO_SUFFIXES))
        raise InputError(f"{folder} holds no photos ({suffixes})", "choose the folder of the photos")
    return photos


def fitting(path: Path, frames: list[ArtifactLayers]) -> ArtifactLayers:
    """Find the layers that fit a photo: of its size, else of its aspect, resampled to its size.

    Args:
        path: the photo; only its header is read.
        frames: layers to choose from, those of raw frames first.

    Raises:
        InputError: the photo is unreadable or of another aspect.
    """
    with open_photo(path) as image:
        width, height = image.size
    for layers in frames:
        if (layers.camera.width, layers.camera.height) == (width, height):
            return layers
    for layers in frames:
        trained = layers.camera.width / layers.camera.height
        if abs(width / height / trained - 1) < MAX_ASPECT_DIFFERENCE:
            return layers.sized(width, height)
    sizes = ", ".join(f"{f.camera.width} x {f.camera.height} ({f.frame})" for f in frames)
    raise InputError(
        f"{path} is {width} x {height}, the overlay's frame {sizes}",
        "choose photos of the camera that it was trained on",
    )


def restore_photos(folder: Path, photos: list[Path], frames: list[ArtifactLayers], output: Path) -> Iterator[Recovery]:
    """Remove the artifact from photos and write them as PNG, with a mask for every size of photo.

    Args:
        folder: paths in `output` are the photos' paths relative to this folder.
        photos: from `find_photos`.
        frames: layers to choose from, those of raw frames first.
        output: folder to write into; `photos/` and, per size, `mask_white_is_scene_WxH.png` (black: not recovered).

    Yields:
        Statistics of each photo, in order.

    Raises:
        InputError: a photo is unreadable or of another frame.
    """
    sized: dict[Path, ArtifactLayers] = {}
    for path in photos:
        layers = fitting(path, [*sized.values(), *frames])
        sized[path] = layers
        name = f"mask_white_is_scene_{layers.camera.width}x{layers.camera.height}.png"
        if not (output / name).exists():
            seen = recoverable(layers)
            output.mkdir(parents=True, exist_ok=True)
            Image.fromarray(seen.astype(np.uint8) * 255).save(output / name)

    def restore_one(path: Path) -> Recovery:
        layers = sized[path]
        photo = read_photo(path, (layers.camera.width, layers.camera.height))
        clean, seen, implausible = restore(photo, layers)
        place = (output / "photos" / path.relative_to(folder)).with_suffix(".png")
        write_photo(place, clean)
        lower_bound = float((clipped(photo, layers) & seen).mean())
        return Recovery(path.relative_to(folder), float(1 - seen.mean()), implausible, lower_bound)

    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(restore_one, photos)
