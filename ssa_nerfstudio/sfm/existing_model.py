"""A model that COLMAP has made already: found, checked, and assigned to the photos on disk."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.pycolmap_import import import_pycolmap
from ssa_nerfstudio.data.photos import UPRIGHT
from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    import pycolmap

_LOG = logging.getLogger(__name__)

_PLACES = ("", "sparse", "colmap/sparse")
"""Where a model is in the folder that the user names; below the last two it has a number."""
_MIN_PHOTOS = 3
"""Of a camera. COLMAP may give each photo one of its own, but an artifact belongs to all of a camera's photos."""
_SHORTEST = {"cameras.bin": 24, "images.bin": 64, "points3D.bin": 43}
"""Bytes of an entry, at least. Each file states their number first; COLMAP believes it, and fills the memory."""
_PARAMETERS = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
"""Where fx, fy, cx, cy, k1, k2, p1, p2 are in the parameters of COLMAP's cameras; what is missing is 0."""


@dataclass(frozen=True)
class KnownPhoto:
    """What the model says of a photo."""

    pose: np.ndarray
    """Camera from world [3, 4], COLMAP's axes."""
    observations: np.ndarray
    """Where it observes points, [N, 2], pixels."""


@dataclass(frozen=True)
class ExistingModel:
    """A model of photos on disk."""

    path: Path
    sources: tuple[Source, ...]
    """The photos of each camera of the model, without a pose, too."""
    lenses: tuple[list[float], ...]
    """Of each camera fx, fy, cx, cy, k1, k2, p1, p2."""
    photos: dict[Path, KnownPhoto]
    """By the photo's file."""


def read_existing_model(path: Path, photos: Path, sources: Sequence[Source]) -> ExistingModel:
    """Read a model, binary or text, and find its photos.

    Args:
        path: its folder, or one that holds it in sparse/0 or colmap/sparse/0; the largest where there are several.
        photos: the folder that COLMAP read the photos from, to which the model's names are relative.
        sources: the photos in it, in the order of the capture. They are divided by the model's cameras.

    Raises:
        InputError: there is no model, it is broken, its photos are others, or its lens is no OPENCV lens.
    """
    folder = _find(path)
    model = _load(folder)
    if any(source.videos for source in sources):
        raise InputError(f"{photos} holds videos, {path} has the poses of photos", "give the photos it was made from")
    names = {(photos / image.name).resolve(): image for image in model.images.values() if image.has_pose}
    if not names:
        raise InputError(f"{path} holds no photo with a pose", "give another model, or leave out --colmap")
    present = {file: names[file.resolve()] for s in sources for file in s.photos if file.resolve() in names}
    if len(present) < 2:
        example = min(image.name for image in names.values())
        raise InputError(
            f"{photos} has {len(present)} of {counted(len(names), 'photo')} with a pose in {path} (one is {example})",
            "give the folder that COLMAP had as --image_path",
        )
    if left := len(names) - len(present):
        _LOG.warning(f"{counted(left, 'photo')} of {path} left out: not in {photos}")
    cameras = [camera for source in sources for camera in _by_camera(source, present, model)]
    known = {file: _known(image, path) for file, image in present.items()}
    return ExistingModel(path, tuple(source for source, _ in cameras), tuple(lens for _, lens in cameras), known)


def _find(path: Path) -> Path:
    """The model's folder; of several, that whose file of images is largest."""
    folders = [path / _PLACES[0], *(model for place in _PLACES[1:] for model in sorted((path / place).glob("[0-9]*")))]
    files = [file for folder in folders for file in folder.glob("images.*") if file.suffix in (".bin", ".txt")]
    files = [file for file in files if file.with_stem("cameras").is_file()]
    if not files:
        raise InputError(
            f"{path} holds no model of COLMAP (cameras and images, .bin or .txt)",
            "give the folder that colmap mapper wrote, for example sparse/0",
        )
    return max(files, key=lambda file: file.stat().st_size).parent


def _load(folder: Path) -> pycolmap.Reconstruction:
    """Read a model, first in a child process: COLMAP's reader aborts the process over some broken files."""
    files = [file for file in map(folder.joinpath, _SHORTEST) if file.is_file()]
    sound = all(np.fromfile(f, "<u8", 1).sum(dtype=float) * _SHORTEST[f.name] <= f.stat().st_size for f in files)
    trial = [sys.executable, "-c", "import sys, pycolmap; pycolmap.Reconstruction(sys.argv[1])", str(folder)]
    if not sound or subprocess.run(trial, capture_output=True).returncode:
        raise InputError(f"{folder} cannot be read as a model of COLMAP", "export it again, or leave out --colmap")
    return import_pycolmap().Reconstruction(folder)


def _by_camera(
    source: Source, present: dict[Path, pycolmap.Image], model: pycolmap.Reconstruction
) -> list[tuple[Source, list[float]]]:
    """Divide a folder's photos by the cameras of the model, each with its lens.

    Photos without a pose are of the camera of their nearest neighbor in order that has one.
    """
    found = [(number, present[file].camera_id) for number, file in enumerate(source.photos) if file in present]
    if not found:
        raise InputError(f"{source.path} has no photo with a pose in the model", "leave the folder out")
    _check(source, [model.cameras[camera] for camera in {camera for _, camera in found}])
    used = [camera for _, camera in found]
    own = sorted({camera for camera in used if used.count(camera) >= _MIN_PHOTOS}) or [used[0]]
    members: dict[int, list[Path]] = {camera: [] for camera in own}
    certain = [(number, camera) for number, camera in found if camera in own]
    for number, file in enumerate(source.photos):
        _, camera = min(certain, key=lambda each: abs(each[0] - number))
        members[camera].append(file)
    divided = []
    for camera, files in members.items():
        folder = "" if source.name == "frame" else f"{source.name}_"
        name = source.name if len(own) == 1 else f"{folder}colmap_camera_{camera}"
        cameras = [model.cameras[c] for c in ([camera] if used.count(camera) >= _MIN_PHOTOS else {*used})]
        lens = np.median([_lens(each) for each in cameras], axis=0).tolist()
        divided.append((replace(source, name=name, photos=tuple(files)), lens))
    return divided


def _check(source: Source, cameras: Sequence[pycolmap.Camera]) -> None:
    for camera in cameras:
        if source.orientation != UPRIGHT:
            raise InputError(
                f"{source.photos[0]} is turned by its EXIF orientation, which COLMAP ignores",
                "leave out --colmap, or turn the pixels and make the model again",
            )
        if (camera.width, camera.height) != (source.width, source.height):
            raise InputError(
                f"{source.photos[0]} is {source.width} x {source.height}, its camera in the model has "
                f"{camera.width} x {camera.height}",
                "give the photos that the model was made from",
            )
        if camera.model.name not in _PARAMETERS:
            raise InputError(
                f"the model has a {camera.model.name} camera; {', '.join(_PARAMETERS)} can be used",
                "undistort it with colmap image_undistorter and give its photos and model, or leave out --colmap",
            )
        if not np.isfinite(camera.params).all():
            raise InputError("the model has a camera whose parameters are not finite", "make it again")


def _lens(camera: pycolmap.Camera) -> list[float]:
    values = [float(camera.params[at]) for at in _PARAMETERS[camera.model.name]]
    return values + [0.0] * (8 - len(values))


def _known(image: pycolmap.Image, path: Path) -> KnownPhoto:
    pose = image.cam_from_world().matrix()
    if not np.isfinite(pose).all():
        raise InputError(f"{path}: the pose of {image.name} is not finite", "make the model again")
    at = np.array([point.xy for point in image.get_observation_points2D()]).reshape(-1, 2)
    return KnownPhoto(pose, at)
