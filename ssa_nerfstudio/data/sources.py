"""What a folder of photos or videos holds, checked before any work is done."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image

from ssa_nerfstudio.data.video import Video
from ssa_nerfstudio.errors import InputError

PHOTOS = {".jpg", ".jpeg", ".png", ".heic", ".heif", ".webp", ".tif", ".tiff", ".bmp"}
"""Suffixes of photos, in lower case."""
VIDEOS = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts"}
"""Suffixes of videos, in lower case."""
_HEIF = {".heic", ".heif"}
_UPRIGHT = 1
_ON_THE_SIDE = {5, 6, 7, 8}
_MODES = {"RGB", "L", "RGBA"}


@dataclass(frozen=True)
class Source:
    """The photos or videos of one pass: one camera, one frame size, one orientation."""

    name: str
    """What the dataset's photos of this pass are called: NAME_00001.jpg."""
    path: Path
    """Where they come from, as it was given."""
    photos: tuple[Path, ...]
    """In the order of their names, numbers in them by value; empty for videos."""
    videos: tuple[Video, ...]
    """In the same order; empty for photos."""
    width: int
    """Of the upright frame, pixels."""
    height: int
    """Of the upright frame, pixels."""
    orientation: int = _UPRIGHT
    """EXIF orientation of all photos, 1 to 8."""
    left_out: tuple[Path, ...] = ()
    """Videos that lie beside photos."""

    @property
    def rewritten(self) -> bool:
        """Whether photos are turned or converted on their way, so that they cannot be copied byte for byte."""
        return self.orientation != _UPRIGHT or any(path.suffix.lower() in _HEIF for path in self.photos)

    def fingerprint(self) -> list[list[str | int]]:
        """Name, size and time of change of every file: another list means other input."""
        files = self.photos or [video.path for video in self.videos]
        return [[str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns] for file in files]


def read_source(path: Path, name: str, least: int) -> Source:
    """Finds the photos or videos of one pass and checks that one camera can have taken them all.

    Photos are opened, not decoded. Hidden files are passed over, and videos that lie beside photos (phones store
    moving copies of photos) are left out.

    Args:
        path: a folder of photos or of videos (subfolders are not searched), or one video.
        name: what the dataset calls this pass.
        least: photos that are needed, at least 1.

    Raises:
        InputError: nothing usable is there, a file cannot be read, sizes or orientations differ.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist", "give a folder of photos, a folder of videos or a video")
    files = [path] if path.is_file() else sorted(path.iterdir(), key=_natural)
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    photos = [file for file in files if file.suffix.lower() in PHOTOS and path.is_dir()]
    videos = [file for file in files if file.suffix.lower() in VIDEOS]
    if photos:
        return _photos(path, name, least, photos, videos)
    if videos:
        return _videos(path, name, videos)
    known = ", ".join(sorted(suffix[1:] for suffix in PHOTOS | VIDEOS))
    raise InputError(f"{path} holds no photo and no video ({known})", "put them there or name another folder")


def open_photo(path: Path) -> Image.Image:
    """Opens a photo without decoding it; HEIC needs the package pillow-heif.

    Raises:
        InputError: it is none.
    """
    if path.suffix.lower() in _HEIF:
        try:
            from pillow_heif import register_heif_opener  # pyright: ignore[reportMissingImports] - optional
        except ImportError as error:
            raise InputError(
                f"{path} needs a decoder: pip install pillow-heif, or convert the photos to JPEG"
            ) from error
        register_heif_opener()
    try:
        return Image.open(path)
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path} is no photo that can be read ({error})", "copy it again or take it out") from error


def _photos(path: Path, name: str, least: int, photos: list[Path], videos: list[Path]) -> Source:
    if len(photos) < least:
        raise InputError(f"{path} holds {len(photos)} photo{'s'[: len(photos) > 1]}, {least} are needed", "add more")
    first: tuple[tuple[int, int], int] | None = None
    for photo in photos:
        with open_photo(photo) as image:
            mode, size = image.mode, image.size
            try:
                orientation = image.getexif().get(ExifTags.Base.Orientation, _UPRIGHT)
            except (OSError, SyntaxError, ValueError) as error:  # a PNG is decoded for it
                raise InputError(
                    f"{photo} is broken ({error})", "copy it again from its source or take it out"
                ) from error
        if mode not in _MODES:
            raise InputError(f"{photo} is of mode {mode}", "convert it to 8-bit RGB")
        first = first or (size, orientation)
        if orientation != first[1]:
            raise InputError(
                f"{photo} has EXIF orientation {orientation}, {photos[0].name} has {first[1]}: what sticks to the "
                "frame does so in one orientation",
                "process one of them, or remove the tag from all photos",
            )
        if size != first[0]:
            raise InputError(
                f"{photo} is {size[0]} x {size[1]}, {photos[0].name} is {first[0][0]} x {first[0][1]}",
                "one folder holds one camera in one orientation, take the others out",
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
                "one folder holds one camera in one orientation, take the others out",
            )
    return Source(name, path, (), tuple(videos), first.width, first.height)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sorts frame_9 before frame_10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]
