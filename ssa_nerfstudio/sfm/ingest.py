"""Photos on their way into the dataset: copied byte for byte where they can be, numbered in order."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
from PIL import Image, ImageOps

from ssa_nerfstudio.data.sources import Source, open_photo
from ssa_nerfstudio.errors import InputError

_TRAINED_ON = 1600
"""Longest side that nerfstudio trains on by itself, pixels: it looks for photos of 1/2, 1/4, ... in images_2, ..."""
_LOSSLESS = {".png", ".tif", ".tiff", ".bmp"}
_QUALITY = {".jpg": {"quality": 95, "subsampling": 0}, ".png": {"compress_level": 1}}


@dataclass(frozen=True)
class Photo:
    """A photo of the dataset."""

    name: str
    """Its file in images/."""
    source: str
    """The file it was, or the video and the number of the frame."""


def ingest(source: Source, dataset: Path, frames: int, on_photo: Callable[[], None]) -> list[Photo]:
    """Puts a pass's photos into the dataset's images/, unchanged where they are upright JPEG or PNG.

    Others are stored upright: lossless ones as PNG, the rest and frames of videos as JPEG (quality 95, full chroma).
    Photos whose longer side exceeds 1600 pixels get copies of 1/2, 1/4, ... in images_2, ..., as nerfstudio expects.
    What an earlier run has brought in is kept.

    Args:
        source: the pass.
        dataset: folder to write into.
        frames: how many frames to take from videos, at least 1.
        on_photo: called after every photo.

    Returns:
        The photos in order.

    Raises:
        InputError: a photo cannot be decoded.
    """
    record = dataset / f".{source.name}.json"
    if record.is_file():
        photos = [Photo(**photo) for photo in json.loads(record.read_text(encoding="utf-8"))]
        for _ in photos:
            on_photo()
        return photos
    (dataset / "images").mkdir(exist_ok=True)
    photos = []
    for photo in _videos(source, dataset, frames) if source.videos else _photos(source, dataset):
        _shrink(dataset, photo.name)
        photos.append(photo)
        on_photo()
    _write(record, lambda path: path.write_text(json.dumps([asdict(photo) for photo in photos]), encoding="utf-8"))
    return photos


def expected(source: Source, frames: int) -> int:
    """How many photos a pass will have, about."""
    return min(frames, sum(video.frames for video in source.videos)) if source.videos else len(source.photos)


def _photos(source: Source, dataset: Path) -> Iterator[Photo]:
    for number, file in enumerate(source.photos, 1):
        suffix = file.suffix.lower()
        kept = suffix in (".jpg", ".jpeg", ".png") and source.orientation == 1
        name = f"{source.name}_{number:05d}{suffix if kept else '.png' if suffix in _LOSSLESS else '.jpg'}"
        target = dataset / "images" / name
        if not target.is_file():
            with open_photo(file) as image:
                try:
                    image.load()
                except (OSError, SyntaxError, ValueError) as error:
                    raise InputError(
                        f"{file} is broken ({error})", "copy it again from its source or take it out"
                    ) from error
                if kept:
                    _write(target, lambda path, file=file: shutil.copyfile(file, path))
                else:
                    _save(target, ImageOps.exif_transpose(image))
        yield Photo(name, file.name)


def _videos(source: Source, dataset: Path, frames: int) -> Iterator[Photo]:
    total = sum(video.frames for video in source.videos)
    number = 0
    for video in source.videos:
        for frame, picture in video.sharpest(max(1, round(frames * video.frames / total))):
            number += 1
            name = f"{source.name}_{number:05d}.jpg"
            _save(dataset / "images" / name, Image.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)))
            yield Photo(name, f"{video.path.name}, frame {frame}")


def _shrink(dataset: Path, name: str) -> None:
    """Copies of 1/2, 1/4, ... until the longer side is at most what nerfstudio trains on."""
    with Image.open(dataset / "images" / name) as image:
        factor = 2
        while 2 * max(image.size) / factor > _TRAINED_ON:
            target = dataset / f"images_{factor}" / name
            if not target.is_file():
                target.parent.mkdir(exist_ok=True)
                size = image.width // factor, image.height // factor
                _save(target, image.resize(size, Image.Resampling.BOX))
            factor *= 2


def _save(target: Path, image: Image.Image) -> None:
    """Stores a picture with its EXIF data, from which the focal length is read."""
    kind = ".png" if target.suffix == ".png" else ".jpg"
    if kind == ".jpg" and image.mode not in ("RGB", "L"):
        image = image.convert("RGB")
    form = {".png": "PNG", ".jpg": "JPEG"}[kind]
    _write(target, lambda path: image.save(path, form, exif=image.getexif(), **_QUALITY[kind]))


def _write(target: Path, write: Callable[[Path], object]) -> None:
    """Writes a file that is there only when it is whole."""
    part = target.with_name(f".{target.name}.part")
    write(part)
    os.replace(part, target)
