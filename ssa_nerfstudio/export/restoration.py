"""Photos restored where the artifact lets light through: C = (I - B) / T, which is (I - A W) / (1 - A).

Only photos that show the artifact are touched, only where it changes them, and what it hides stays black.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import scipy.optimize
from PIL import Image

from ssa_nerfstudio.data.photos import open_photo, read_photo, write_photo
from ssa_nerfstudio.data.sources import PHOTO_SUFFIXES, VIDEO_SUFFIXES
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers

NOISE = 2 / 255
"""What pixels of photos and of learned layers are off by: rounding, JPEG, an overlay that is almost clear. A pixel that
an artifact cannot change by more is left as it is."""
MAX_ASPECT_DIFFERENCE = 0.005
"""Relative difference of aspect up to which photos count as the training photos at another resolution."""


@dataclass(frozen=True)
class Recovery:
    """Statistics of one photo."""

    path: Path
    """Relative to the folder of photos."""
    shows: bool
    """Whether it shows the artifact; one that does not is written as it is."""
    hidden: float = 0.0
    """Fraction of pixels that were not recovered and are black."""
    implausible: float = 0.0
    """Fraction of recovered pixels that are darker than black or brighter than white by more than NOISE."""
    clipped: float = 0.0
    """Fraction of pixels that are lower bounds: added light saturated the photo."""


def recoverable(layers: ArtifactLayers, threshold: float) -> np.ndarray:
    """Pixels in which an artifact leaves enough of the scene, bool [H, W].

    What an estimate is wrong by is multiplied by 1 / T, and light hides what it makes white. The edge of what is hidden
    is known to a pixel: its outer rim, a mixture in an unknown ratio, is not recovered either.

    Args:
        layers: at the resolution that they were learned in.
        threshold: of the matte, in (0, 1); what exceeds it is hidden (`ArtifactLayers.covered`).
    """
    hidden = layers.covered(threshold)
    rim = cv2.dilate(hidden.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return ~(hidden | (rim & changed(layers)))


def changed(layers: ArtifactLayers) -> np.ndarray:
    """Pixels in which |I - C| = |B - (1 - T) C| exceeds NOISE for some C in [0, 1], bool [H, W]."""
    over_black, over_white = layers.addition, layers.addition - (1 - layers.transmittance)
    return (np.maximum(np.abs(over_black), np.abs(over_white)) > NOISE).any(axis=-1)


def shows(photo: np.ndarray, layers: ArtifactLayers) -> bool:
    """Whether a photo is more likely with the artifact in front of it than without, at any of three resolutions.

    Reduced, a photo forgives an overlay that is off by a pixel. Where both are equally likely, as behind a clear
    overlay, it shows it.

    Args:
        photo: uint8 [H, W, 3].
        layers: of the photo's frame and size.
    """
    height, width = photo.shape[:2]
    for factor in (1, 2, 4):
        size = max(1, width // factor), max(1, height // factor)
        if _evidence(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), layers.sized(*size)) >= 0:
            return True
    return False


def _evidence(photo: np.ndarray, layers: ArtifactLayers) -> float:
    """Log-likelihood of a photo with the artifact in front of it minus that without.

    Differences between neighboring pixels of a photo are about Laplacian (Huang & Mumford 1999, "Statistics of natural
    images and models"), and an artifact that is taken away where there is none leaves its edges behind, like one that
    is left. So the differences of (I - B) / T and of I are compared where the artifact changes the photo: each with
    the scale that fits it best, with noise, which division by T enlarges, and with the density's factor 1 / T. The
    contrast alone decides nothing: it cancels.
    """
    image, region = photo / np.float32(255), changed(layers)
    transmittance = np.maximum(layers.transmittance, np.float32(NOISE))
    restored = (image - layers.addition) / transmittance
    density = 0.0
    before, after, noise = [], [], []
    for first, second in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        pairs = region[first] | region[second]
        before.append(np.abs(image[first] - image[second])[pairs])
        after.append(np.abs(restored[first] - restored[second])[pairs])
        near, far = transmittance[first][pairs], transmittance[second][pairs]
        noise.append(NOISE * (1 / near + 1 / far))
        density -= float(np.log(near * far).sum(dtype=np.float64)) / 2
    shown = density + _likelihood(np.concatenate(after), np.concatenate(noise))
    return shown - _likelihood(np.concatenate(before), np.float32(2 * NOISE))


def _likelihood(differences: np.ndarray, noise: np.ndarray | np.float32) -> float:
    """Largest log-likelihood of Laplacian differences over the scale of a scene that the noise is added to."""

    def unlikely(logarithm: float) -> float:
        scale = np.float32(np.exp(logarithm)) + noise
        return float((differences / scale + np.log(scale)).sum(dtype=np.float64))

    return -scipy.optimize.minimize_scalar(unlikely, bounds=np.log([1e-3, 1]), method="bounded").fun


def clipped(photo: np.ndarray, layers: ArtifactLayers) -> np.ndarray:
    """Pixels of a photo uint8 [H, W, 3] that added light may have saturated, bool [H, W]: I = clip(T C + B).

    An alpha-blended artifact, T = 1 - A and B = A W, never saturates a photo.
    """
    beyond = layers.transmittance + layers.addition > 1 + 0.5 / 255
    return ((photo == 255) & beyond).any(axis=-1)


def restore(photo: np.ndarray, layers: ArtifactLayers, seen: np.ndarray) -> tuple[np.ndarray, float]:
    """Remove an artifact from a photo.

    Args:
        photo: uint8 [H, W, 3].
        layers: of the photo's frame and size.
        seen: pixels to recover, bool [H, W].

    Returns:
        The photo uint8 [H, W, 3], black where not recovered, and the fraction of the recovered pixels that is
        implausible.
    """
    scene = photo - np.float32(255) * layers.addition
    scene /= np.maximum(layers.transmittance, np.float32(NOISE))
    alike = ~changed(layers)
    scene[alike] = photo[alike]
    wrong = ((scene < -255 * NOISE) | (scene > 255 * (1 + NOISE))).any(axis=-1) & seen
    scene[~seen] = 0
    return np.rint(scene).clip(0, 255).astype(np.uint8), float(wrong.sum() / max(1, seen.sum()))


def find_photos(folder: Path) -> list[Path]:
    """Find the photos in a folder and its subfolders, sorted.

    Raises:
        InputError: there are none, or the restored photos of two would have one name.
    """
    if not folder.is_dir():
        video = folder.suffix.lower() in VIDEO_SUFFIXES
        frames = "write its frames to a folder, as by ffmpeg -i CLIP FOLDER/%05d.png, and give that"
        raise InputError(f"{folder} is no folder", frames if video else "choose the folder of the photos")
    photos = sorted(path for path in folder.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
    if not photos:
        suffixes = ", ".join(sorted(PHOTO_SUFFIXES))
        raise InputError(f"{folder} holds no photos ({suffixes})", "choose the folder of the photos")
    places: dict[Path, Path] = {}
    for path in photos:
        other = places.setdefault(path.with_suffix(".png"), path)
        if other != path:
            raise InputError(f"{other} and {path} would both be written as {path.stem}.png", "rename one")
    return photos


def fitting(path: Path, frames: list[ArtifactLayers]) -> ArtifactLayers:
    """Find the layers that fit a photo: of its size, else of its aspect.

    Args:
        path: the photo; only its header is read.
        frames: layers to choose from, those of raw frames first.

    Raises:
        InputError: the photo is unreadable or of another aspect.
    """
    width, height = photo_size(path)
    for layers in frames:
        if (layers.camera.width, layers.camera.height) == (width, height):
            return layers
    for layers in frames:
        trained = layers.camera.width / layers.camera.height
        if abs(width / height / trained - 1) < MAX_ASPECT_DIFFERENCE:
            return layers
    sizes = ", ".join(f"{f.camera.width} x {f.camera.height} ({f.frame})" for f in frames)
    raise InputError(
        f"{path} is {width} x {height}, the overlay's frame {sizes}",
        "choose photos of the camera that it was trained on",
    )


def restore_photos(
    folder: Path, photos: list[Path], frames: list[ArtifactLayers], output: Path, threshold: float
) -> Iterator[Recovery]:
    """Remove the artifact from photos and write them as PNG, with a mask for every size of photo.

    Args:
        folder: paths in `output` are the photos' paths relative to this folder.
        photos: from `find_photos`.
        frames: layers to choose from, those of raw frames first.
        output: folder to write into; `photos/` and, per size, `mask_white_is_scene_WxH.png` (black: not recovered).
        threshold: of `recoverable`.

    Yields:
        Statistics of each photo, in order.

    Raises:
        InputError: a photo is unreadable or of another frame.
    """
    sizes = {path: photo_size(path) for path in photos}
    learned = {path: fitting(path, frames) for path in photos}
    sized: dict[tuple[int, int], tuple[ArtifactLayers, np.ndarray]] = {}
    for path, (width, height) in sizes.items():
        if (width, height) not in sized:
            hidden = (~recoverable(learned[path], threshold)).astype(np.float32)
            method = cv2.INTER_AREA if width < hidden.shape[1] else cv2.INTER_LINEAR
            seen = cv2.resize(hidden, (width, height), interpolation=method) == 0
            sized[width, height] = learned[path].sized(width, height), seen
            output.mkdir(parents=True, exist_ok=True)
            Image.fromarray(seen).save(output / f"mask_white_is_scene_{width}x{height}.png")

    def restore_one(path: Path) -> Recovery:
        layers, seen = sized[sizes[path]]
        photo = read_photo(path, sizes[path])
        name = path.relative_to(folder)
        place = (output / "photos" / name).with_suffix(".png")
        if not shows(*_at_learned_size(photo, layers, learned[path])):
            write_photo(place, photo)
            return Recovery(name, shows=False)
        clean, implausible = restore(photo, layers, seen)
        write_photo(place, clean)
        lower_bound = float((clipped(photo, layers) & seen).mean())
        return Recovery(name, True, float(1 - seen.mean()), implausible, lower_bound)

    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(restore_one, photos)


def _at_learned_size(
    photo: np.ndarray, layers: ArtifactLayers, learned: ArtifactLayers
) -> tuple[np.ndarray, ArtifactLayers]:
    """A photo and its layers, where it is larger at the size that the layers were learned at: finer edges are blur."""
    size = learned.camera.width, learned.camera.height
    if layers.camera.width <= size[0]:
        return photo, layers
    return cv2.resize(photo, size, interpolation=cv2.INTER_AREA), learned


def photo_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo, pixels, from its header."""
    with open_photo(path) as image:
        return image.size
