"""Photos without their artifact, where it let light through: C = (I - B) / T, which is (I - A W) / (1 - A)."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ssa_nerfstudio.data.photos import open_photo, read_photo, write_photo
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers

LEAST_TRANSMITTANCE = 0.05
"""A pixel whose matte exceeds 0.95 in any channel is not recovered: an error of one gray level would become twenty.
Nor is one to which more than 0.95 of white was added: what a photo can still tell is less than that."""
SAME_ASPECT = 0.005
"""Photos whose aspect differs by less than this, relatively, may be the trained ones at another resolution."""
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"}
"""Files of a folder that count as photos."""


@dataclass(frozen=True)
class Recovery:
    """What became of one photo."""

    path: Path
    """Relative to the folder of photos."""
    hidden: float
    """Fraction of pixels behind a matte above 0.95: not recovered, black."""
    implausible: float
    """Fraction of recovered pixels that came out darker than black or brighter than white by over two gray levels."""
    clipped: float
    """Fraction of pixels that are recovered as a lower bound: added light made the photo white."""


def recoverable(layers: ArtifactLayers) -> np.ndarray:
    """Where an artifact leaves enough of the scene in a photo, bool [H, W] (`LEAST_TRANSMITTANCE`)."""
    return np.minimum(layers.transmittance, 1 - layers.addition).min(axis=-1) >= LEAST_TRANSMITTANCE


def clipped(photo: np.ndarray, layers: ArtifactLayers) -> np.ndarray:
    """Where a photo uint8 [H, W, 3] is white and need not be by the scene alone, bool [H, W]: I = clip(T C + B).

    An artifact of one picture, T = 1 - A and B = A W, never reaches beyond white.
    """
    beyond = layers.transmittance + layers.addition > 1 + 0.5 / 255
    return ((photo == 255) & beyond).any(axis=-1)


def restore(photo: np.ndarray, layers: ArtifactLayers) -> tuple[np.ndarray, np.ndarray, float]:
    """Take an artifact off a photo.

    Args:
        photo: uint8 [H, W, 3].
        layers: of the photo's frame and size.

    Returns:
        The photo uint8 [H, W, 3], black where hidden; what could be recovered, bool [H, W]; and the fraction of it
        that is implausible.
    """
    seen = recoverable(layers)
    scene = photo - np.float32(255) * layers.addition
    scene /= np.maximum(layers.transmittance, np.float32(LEAST_TRANSMITTANCE))
    wrong = ((scene < -2) | (scene > 257)).any(axis=-1) & seen
    scene[~seen] = 0
    return np.rint(scene).clip(0, 255).astype(np.uint8), seen, float(wrong.sum() / max(1, seen.sum()))


def find_photos(folder: Path) -> list[Path]:
    """The photos below a folder, sorted.

    Raises:
        InputError: there are none.
    """
    if not folder.is_dir():
        raise InputError(f"--apply {folder} is no folder", "give the folder of the photos")
    photos = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not photos:
        raise InputError(
            f"--apply {folder} holds no photos ({', '.join(sorted(SUFFIXES))})", "give the folder of the photos"
        )
    return photos


def fitting(path: Path, frames: list[ArtifactLayers]) -> ArtifactLayers:
    """The layers of a photo's frame, at its size: of the same size first, else of the same aspect, enlarged.

    Args:
        path: the photo, of which only the header is read.
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
        if abs(width / height / trained - 1) < SAME_ASPECT:
            return layers.sized(width, height)
    sizes = ", ".join(f"{f.camera.width} x {f.camera.height} ({f.frame})" for f in frames)
    raise InputError(
        f"{path} is {width} x {height}, the overlay's frame {sizes}", "give photos of the camera it was trained on"
    )


def restore_photos(folder: Path, photos: list[Path], frames: list[ArtifactLayers], output: Path) -> Iterator[Recovery]:
    """Take the artifact off photos and write them as PNG, each under its own name, with a mask for every size.

    Args:
        folder: what the photos' places in `output` are relative to.
        photos: from `find_photos`.
        frames: layers to choose from, those of raw frames first.
        output: folder to write into; `photos/` and, per size, `mask_white_is_scene_WxH.png` (black: not recovered).

    Yields:
        What became of each photo, in order.

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

    def one(path: Path) -> Recovery:
        layers = sized[path]
        photo = read_photo(path, (layers.camera.width, layers.camera.height))
        clean, seen, implausible = restore(photo, layers)
        place = (output / "photos" / path.relative_to(folder)).with_suffix(".png")
        write_photo(place, clean)
        lower_bound = float((clipped(photo, layers) & seen).mean())
        return Recovery(path.relative_to(folder), float(1 - seen.mean()), implausible, lower_bound)

    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(one, photos)
