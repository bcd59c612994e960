"""Photos on their way into the dataset: copied byte for byte where possible, numbered in order."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
from PIL import Image

from ssa_nerfstudio.data.photos import UPRIGHT, load_photo
from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.data.writing import staged_file

_MAX_TRAINING_SIZE = 1600
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


def ingest(source: Source, dataset: Path, frames: int, advance: Callable[[], None]) -> list[Photo]:
    """Put the photos of a pass into the dataset's images/, unchanged where they are upright JPEG or PNG.

    Others are stored upright: lossless ones as PNG, the rest and frames of videos as JPEG (quality 95, full chroma).
    Photos whose longer side exceeds 1600 pixels get copies of 1/2, 1/4, ... in images_2, ..., as nerfstudio expects.
    What an interrupted run brought in is kept.

    Args:
        source: the pass.
        dataset: folder to write into.
        frames: how many frames to take from videos, at least 1.
        advance: called after every photo.

    Returns:
        The photos in order.

    Raises:
        InputError: a photo cannot be decoded.
        OSError: a file cannot be written.
    """
    record = dataset / f".{source.name}{_RECORD}"
    if record.is_file():
        photos = [Photo(**photo) for photo in json.loads(record.read_text(encoding="utf-8"))]
        for _ in photos:
            advance()
        return photos
    (dataset / "images").mkdir(exist_ok=True)
    photos = []
    for photo in _from_videos(source, dataset, frames) if source.videos else _from_photos(source, dataset):
        _write_reduced(dataset, photo.name)
        photos.append(photo)
        advance()
    with staged_file(record) as part:
        part.write_text(json.dumps([asdict(photo) for photo in photos]), encoding="utf-8")
    return photos


def remove_records(dataset: Path) -> None:
    """Remove from a complete dataset what interrupted runs need."""
    for record in dataset.glob(f".*{_RECORD}"):
        record.unlink()


def expected_count(source: Source, frames: int) -> int:
    """About how many photos a pass will have."""
    return min(frames, sum(video.frames for video in source.videos)) if source.videos else len(source.photos)


def _from_photos(source: Source, dataset: Path) -> Iterator[Photo]:
    for number, file in enumerate(source.photos, 1):
        suffix = file.suffix.lower()
        unchanged = suffix in (".jpg", ".jpeg", ".png") and source.orientation == UPRIGHT
        name = f"{source.name}_{number:05d}{suffix if unchanged else '.png' if suffix in _LOSSLESS else '.jpg'}"
        target = dataset / "images" / name
        if not target.is_file():
            image = load_photo(file, upright=not unchanged)
            if unchanged:
                with staged_file(target) as part:
                    shutil.copyfile(file, part)
            else:
                _save(target, image)
        yield Photo(name, file.name)


def _from_videos(source: Source, dataset: Path, frames: int) -> Iterator[Photo]:
    for number, (video, frame, picture) in enumerate(source.video_frames(frames), 1):
        name = f"{source.name}_{number:05d}.jpg"
        _save(dataset / "images" / name, Image.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)))
        yield Photo(name, f"{video.path.name}, frame {frame}")


def _write_reduced(dataset: Path, name: str) -> None:
    """Write copies of 1/2, 1/4, ... until the longer side is at most what nerfstudio trains on."""
    with Image.open(dataset / "images" / name) as image:  # checked on its way in
        factor = 2
        while 2 * max(image.size) / factor > _MAX_TRAINING_SIZE:
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
