"""Photos or videos in a folder: found, and checked before any work is done."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssa_nerfstudio.data.photos import UPRIGHT, exif_orientation, open_photo
from ssa_nerfstudio.data.video import Video
from ssa_nerfstudio.errors import InputError

PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".heic", ".heif", ".webp", ".tif", ".tiff", ".bmp"}
"""Suffixes of photos, in lower case."""
VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts"}
"""Suffixes of videos, in lower case."""
_ON_THE_SIDE = {5, 6, 7, 8}


@dataclass(frozen=True)
class Source:
    """The photos or videos of one pass: one camera, one frame size, one orientation."""

    name: str
    """Prefix of the dataset's photos of this pass: NAME_00001.jpg."""
    path: Path
    """The folder or video, as the user gave it."""
    photos: tuple[Path, ...]
    """Sorted by name with numbers by value (frame_9 before frame_10); empty for videos."""
    videos: tuple[Video, ...]
    """In the same order; empty for photos."""
    width: int
    """Of the upright frame, pixels."""
    height: int
    """Of the upright frame, pixels."""
    orientation: int = UPRIGHT
    """EXIF orientation of all photos, 1 to 8."""
    skipped_videos: tuple[Path, ...] = ()
    """Videos beside photos: phones store moving copies of photos."""

    def video_frames(self, count: int) -> Iterator[tuple[Video, int, np.ndarray]]:
        """Sharp frames of all videos in order, from each as many as its share of all frames.

        Args:
            count: about how many in all, at least 1.

        Yields:
            The video, the frame's number in it, from 0, and the frame, BGR uint8 [height, width, 3], upright.
        """
        total = sum(video.frames for video in self.videos)
        for video in self.videos:
            for number, frame in video.sharpest(max(1, round(count * video.frames / total))):
                yield video, number, frame

    def fingerprint(self) -> list[list[str | int]]:
        """Name, size and modification time of every file, which tell whether the input has changed."""
        files = self.photos or [video.path for video in self.videos]
        return [[str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns] for file in files]


def read_source(path: Path, name: str, min_photos: int) -> Source:
    """Find the photos or videos of one pass and check that one camera can have taken them all.

    Photos are opened, not decoded. Hidden files and videos beside photos are skipped.

    Args:
        path: a folder of photos or of videos, without its subfolders, or one video.
        name: what the dataset calls this pass.
        min_photos: how many photos are needed, at least 1.

    Raises:
        InputError: the folder holds nothing usable, a file cannot be read, or sizes or orientations differ.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist", "give a folder of photos, a folder of videos or a video")
    files = [path] if path.is_file() else sorted(path.iterdir(), key=_natural)
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    photos = [file for file in files if file.suffix.lower() in PHOTO_SUFFIXES and path.is_dir()]
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES]
    if photos:
        return _photos(path, name, min_photos, photos, videos)
    if videos:
        return _videos(path, name, videos)
    known = ", ".join(sorted(suffix[1:] for suffix in PHOTO_SUFFIXES | VIDEO_SUFFIXES))
    raise InputError(f"{path} holds no photo and no video ({known})", "put them there or name another folder")


def _photos(path: Path, name: str, min_photos: int, photos: list[Path], videos: list[Path]) -> Source:
    if len(photos) < min_photos:
        raise InputError(
            f"{path} holds {len(photos)} photo{'s'[: len(photos) > 1]}, {min_photos} are needed", "add more"
        )
    first: tuple[tuple[int, int], int] | None = None
    for photo in photos:
        with open_photo(photo) as image:
            size, orientation = image.size, exif_orientation(image)
        first = first or (size, orientation)
        if orientation != first[1]:
            raise InputError(
                f"{photo} has EXIF orientation {orientation}, {photos[0].name} has {first[1]}: a static artifact "
                "has one place in photos of one orientation",
                "process one of them, or remove the tag from all photos",
            )
        if size != first[0]:
            raise InputError(
                f"{photo} is {size[0]} x {size[1]}, {photos[0].name} is {first[0][0]} x {first[0][1]}",
                "use one folder for each camera and orientation",
            )
    assert first is not None
    (width, height), orientation = first
    if orientation in _ON_THE_SIDE:
        width, height = height, width
    return Source(name, path, tuple(photos), (), width, height, orientation, tuple(videos))


def _videos(path: Path, name: str, files: list[Path]) -> Source:
    videos = [Video.read(file) for file in files]
    first = videos[0]
    for video in videos:
        if (video.width, video.height) != (first.width, first.height):
            raise InputError(
                f"{video.path} is {video.width} x {video.height}, {first.path.name} is {first.width} x {first.height}",
                "use one folder for each camera and orientation",
            )
    return Source(name, path, (), tuple(videos), first.width, first.height)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts frame_9 before frame_10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]
