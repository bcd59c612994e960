"""Photos on their way into the dataset: copied byte for byte where possible, numbered in order."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.cameras.panorama import Face, cut
from ssa_nerfstudio.data.photos import UPRIGHT, load_photo
from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.data.writing import staged_file

MAX_TRAINING_SIZE = 1600
"""Longest side that nerfstudio trains on without being asked, pixels. Beyond it looks for images_2, images_4, ..."""
_RECORD = ".json"
"""Suffix of the hidden file that lists a pass's photos once all are in."""
_LOSSLESS = {".png", ".tif", ".tiff", ".bmp"}
_QUALITY = {"JPEG": {"quality": 95, "subsampling": 0}, "PNG": {"compress_level": 1}}


@dataclass(frozen=True)
class Photo:
    """A photo of the dataset."""

    name: str
    """Its file in images/."""
    source: str
    """The file it was made from, or the video and the frame's number."""


def ingest(source: Source, dataset: Path, frames: int, advance: Callable[[], None]) -> list[list[Photo]]:
    """Put the photos of a pass into the dataset's images/, unchanged where they are upright JPEG or PNG.

    Others are stored upright: lossless ones as PNG, the rest and frames of videos as JPEG (quality 95, full chroma).
    Of equirectangular photos the faces are stored.
    Photos whose longer side exceeds 1600 pixels get copies of 1/2, 1/4, ... in images_2, ..., as nerfstudio expects.
    What an interrupted run brought in is kept.

    Args:
        source: the pass.
        dataset: folder to write into.
        frames: how many frames to take from videos, at least 1.
        advance: called after every photo of the pass.

    Returns:
        The photos in order, of each of `source.cameras`.

    Raises:
        InputError: a photo cannot be decoded.
        OSError: a file cannot be written.
    """
    record = dataset / f".{source.name}{_RECORD}"
    if record.is_file():
        cameras = [[Photo(**photo) for photo in each] for each in json.loads(read_text(record))]
        for _ in cameras[0]:
            advance()
        return cameras
    (dataset / "images").mkdir(exist_ok=True)
    cameras: list[list[Photo]] = [[] for _ in source.cameras]
    for shot in _from_videos(source, dataset, frames) if source.videos else _from_photos(source, dataset):
        for camera, photo in zip(cameras, shot, strict=True):
            _write_reduced(dataset, photo.name)
            camera.append(photo)
        advance()
    with staged_file(record) as part:
        part.write_text(json.dumps([[asdict(photo) for photo in each] for each in cameras]), encoding="utf-8")
    return cameras


def remove_records(dataset: Path) -> None:
    """Remove from a complete dataset what interrupted runs need."""
    for record in dataset.glob(f".*{_RECORD}"):
        record.unlink()


def expected_count(source: Source, frames: int) -> int:
    """About how many photos a pass will have."""
    return min(frames, sum(video.frames for video in source.videos)) if source.videos else len(source.photos)


def _from_photos(source: Source, dataset: Path) -> Iterator[list[Photo]]:
    for number, file in enumerate(source.photos, 1):
        suffix = file.suffix.lower()
        unchanged = suffix in (".jpg", ".jpeg", ".png") and source.orientation == UPRIGHT and not source.faces
        suffix = suffix if unchanged else ".png" if suffix in _LOSSLESS else ".jpg"
        names = [f"{camera.name}_{number:05d}{suffix}" for camera in source.cameras]
        targets = [dataset / "images" / name for name in names]
        if not all(target.is_file() for target in targets):
            image = load_photo(file, upright=not unchanged)
            if unchanged:
                with staged_file(targets[0]) as part:
                    shutil.copyfile(file, part)
            else:
                _save_all(targets, image, source.faces)
        yield [Photo(name, file.name) for name in names]


def _from_videos(source: Source, dataset: Path, frames: int) -> Iterator[list[Photo]]:
    for number, (video, frame, picture) in enumerate(source.video_frames(frames), 1):
        names = [f"{camera.name}_{number:05d}.jpg" for camera in source.cameras]
        image = Image.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
        _save_all([dataset / "images" / name for name in names], image, source.faces)
        yield [Photo(name, f"{video.path.name}, frame {frame}") for name in names]


def _save_all(targets: Sequence[Path], image: Image.Image, faces: Sequence[Face]) -> None:
    """Store a photo, or the faces of an equirectangular one."""
    if not faces:
        _save(targets[0], image)
        return
    panorama = np.asarray(image.convert("RGB"))
    for target, face in zip(targets, faces, strict=True):
        _save(target, Image.fromarray(cut(panorama, face)))


def _write_reduced(dataset: Path, name: str) -> None:
    """Write copies of 1/2, 1/4, ... until the longer side is at most what nerfstudio trains on."""
    with Image.open(dataset / "images" / name) as image:  # checked on its way in
        factor = 2
        while 2 * max(image.size) / factor > MAX_TRAINING_SIZE:
            target = dataset / f"images_{factor}" / name
            if not target.is_file():
                target.parent.mkdir(exist_ok=True)
                size = image.width // factor, image.height // factor
                _save(target, image.resize(size, Image.Resampling.BOX))
            factor *= 2


def _save(target: Path, image: Image.Image) -> None:
    """Store a picture with its EXIF data, from which the focal length is read."""
    kind = "PNG" if target.suffix == ".png" else "JPEG"
    if kind == "JPEG" and image.mode not in ("RGB", "L"):
        image = image.convert("RGB")
    with staged_file(target) as part:
        image.save(part, kind, exif=image.getexif(), **_QUALITY[kind])
