"""Photos or videos in a folder: found, and checked before any work is done."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.name_list import name_list
from ssa_nerfstudio._system.natural_order import natural_order
from ssa_nerfstudio.cameras.camera_names import camera_of_folder
from ssa_nerfstudio.cameras.panorama import Face
from ssa_nerfstudio.data.photos import UPRIGHT, exif_orientation, open_photo
from ssa_nerfstudio.data.transforms import is_file
from ssa_nerfstudio.data.video import Video
from ssa_nerfstudio.errors import InputError

PHOTO_SUFFIXES = {".jpg", ".jpeg", ".png", ".heic", ".heif", ".webp", ".tif", ".tiff", ".bmp"}
"""Suffixes of photos, in lower case."""
VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts"}
"""Suffixes of videos, in lower case."""
_LOOKED_AT = 1000
"""Files and folders below a folder without photos, among which to look for some."""
_ON_THE_SIDE = {5, 6, 7, 8}
_NAMED = 5
"""Photos that are named before they are counted."""


class SourceCamera(NamedTuple):
    """A camera of the dataset."""

    name: str
    """Prefix of its photos: NAME_00001.jpg."""
    face: Face | None
    """What it sees of equirectangular photos."""


@dataclass(frozen=True)
class Source:
    """The photos or videos of one pass: one camera, one frame size, one orientation."""

    name: str
    """What the dataset calls this pass."""
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
    faces: tuple[Face, ...] = ()
    """Perspective faces to cut out of equirectangular photos; empty for those of any other kind."""

    @property
    def cameras(self) -> list[SourceCamera]:
        """The dataset's cameras: one for each face, or the one that took the photos."""
        if not self.faces:
            return [SourceCamera(self.name, None)]
        return [SourceCamera(f"{self.name}_{face.name}", face) for face in self.faces]

    @property
    def longest_side(self) -> int:
        """Of the dataset's photos, pixels."""
        return self.faces[0].size if self.faces else max(self.width, self.height)

    @property
    def files(self) -> list[Path]:
        """The photos, or the videos."""
        return [*self.photos] or [video.path for video in self.videos]

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
        return [[str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns] for file in self.files]


def read_sources(path: Path, name: str, min_photos: int) -> list[Source]:
    """Find the photos or videos of one pass, a source for each camera that took them.

    A folder without photos and videos of its own is a rig's: each of its subfolders is a camera and names it. Photos of
    several sizes or EXIF orientations in one folder are of several cameras, because an artifact has its place in photos
    of one orientation: `landscape` and `portrait`, or by their size, 640x480.

    Args:
        path: a folder of photos or of videos, a folder of such folders, or one video.
        name: what the dataset calls the only camera.
        min_photos: how many photos are needed of each camera, at least 1.

    Raises:
        InputError: as `read_source`, but for sizes and orientations that enough photos have.
    """
    if path.is_dir() and not any(_media(path)):
        folders = [folder for folder in sorted(path.iterdir(), key=_by_name) if _is_camera(folder)]
        if folders:
            sources = [read_source(folder, camera_of_folder(folder.name), min_photos) for folder in folders]
            for number, source in enumerate(sources):
                if source.name in {other.name for other in sources[:number]}:
                    raise InputError(f"{source.path} has the name of another camera", "rename it")
            return sources
    photos, videos = _media(path)
    if path.is_dir() and photos:
        groups = _by_frame(photos)
        if len(groups) > 1 and min(map(len, groups.values())) >= min_photos:
            return [
                _of_photos(called, path, group, frame, videos if number == 0 else [])
                for number, (called, (frame, group)) in enumerate(zip(_called(groups), groups.items(), strict=True))
            ]
    return [read_source(path, name, min_photos)]


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
    if not path.is_dir() and not path.is_file():
        raise InputError(f"{path} is neither a file nor a folder", "give a folder of photos, of videos, or a video")
    photos, videos = _media(path)
    if not photos and not videos:
        known = ", ".join(sorted(suffix[1:] for suffix in PHOTO_SUFFIXES | VIDEO_SUFFIXES))
        if path.suffix.lower() in PHOTO_SUFFIXES and path.is_file():
            raise InputError(f"{path} is one photo", f"give the folder of all photos, {path.parent}")
        if path.is_file():
            videos = ", ".join(sorted(suffix[1:] for suffix in VIDEO_SUFFIXES))
            raise InputError(
                f"{path} is neither a folder nor a video ({videos})", "give a folder of photos, of videos, or a video"
            )
        below = (file for file in islice(path.rglob("[!.]*"), _LOOKED_AT) if file.suffix.lower() in PHOTO_SUFFIXES)
        first = next((file for file in below if is_file(file)), None)
        remedy = "put them there or name another folder" if first is None else f"give {first.parent}, which does"
        raise InputError(f"{path} holds no photo and no video ({known})", remedy)
    if not photos:
        return _videos(path, name, videos)
    if len(photos) < min_photos:
        raise InputError(f"{path} holds {counted(len(photos), 'photo')}, {min_photos} are needed", "add more")
    groups = _by_frame(photos)
    if len(groups) > 1:
        raise _mixed(groups, min_photos)
    (frame,) = groups
    return _of_photos(name, path, photos, frame, videos)


_Frame = tuple[tuple[int, int], int]
"""Width and height of a photo's pixels, and its EXIF orientation."""


def _media(path: Path) -> tuple[list[Path], list[Path]]:
    """Photos and videos in a folder, or a video itself, in natural order."""
    if not path.is_dir() and not path.is_file():
        return [], []
    files = [path] if path.is_file() else sorted(path.iterdir(), key=_by_name)
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    photos = [file for file in files if file.suffix.lower() in PHOTO_SUFFIXES and path.is_dir()]
    return photos, [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES]


def _is_camera(path: Path) -> bool:
    return path.is_dir() and not path.name.startswith(".") and any(_media(path))


def _by_frame(photos: list[Path]) -> dict[_Frame, list[Path]]:
    groups: dict[_Frame, list[Path]] = {}
    for photo in photos:
        with open_photo(photo) as image:
            groups.setdefault((image.size, exif_orientation(image)), []).append(photo)
    return groups


def _mixed(groups: dict[_Frame, list[Path]], min_photos: int) -> InputError:
    """Names the photos of the frames that too few share, or else of the rarest one, as those that do not belong."""
    usual, *others = sorted(groups, key=lambda frame: -len(groups[frame]))
    rare = [frame for frame in others if len(groups[frame]) < min_photos] or others[-1:]
    odd = [photo for frame in rare for photo in groups[frame]]
    (size, orientation), photo, like = rare[0], odd[0], groups[usual][0].name
    those = name_list([each.name for each in odd]) if len(odd) <= _NAMED else f"{counted(len(odd), 'photo')} like it"
    if size != usual[0]:
        remedies = [f"remove {those}", "use one folder for each camera and orientation"]
        return InputError(
            f"{photo} is {size[0]} x {size[1]}, {like} is {usual[0][0]} x {usual[0][1]}",
            ", or ".join(remedies if len(odd) < min_photos else reversed(remedies)),
        )
    return InputError(
        f"{photo} has EXIF orientation {orientation}, {like} has {usual[1]}: a static artifact has one place in photos "
        "of one orientation",
        f"remove {those}, or the tag from all photos",
    )


def _called(frames: Iterable[_Frame]) -> list[str]:
    """What tells photos apart for those who took them: portrait or landscape, their size, or how it was held."""
    sizes = [(*_upright(frame), frame[1]) for frame in frames]
    shapes = [
        "landscape" if width > height else "portrait" if width < height else "square" for width, height, _ in sizes
    ]
    by_size = [f"{width}x{height}" for width, height, _ in sizes]
    for names in (shapes, by_size):
        if len({*names}) == len(names):
            return names
    return [f"{name}_exif{orientation}" for name, (_, _, orientation) in zip(by_size, sizes, strict=True)]


def _upright(frame: _Frame) -> tuple[int, int]:
    (width, height), orientation = frame
    return (height, width) if orientation in _ON_THE_SIDE else (width, height)


def _of_photos(name: str, path: Path, photos: list[Path], frame: _Frame, videos: list[Path]) -> Source:
    (width, height), orientation = _upright(frame), frame[1]
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


def _by_name(path: Path) -> list[tuple[int, str]]:
    return natural_order(path.name)
