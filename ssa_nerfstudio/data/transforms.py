"""transforms.json, the file that makes a folder a nerfstudio dataset: read and validated in one place.

What nerfstudio accepts is accepted: numbers as strings, intrinsics per frame, photos in images_N.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.data.photos import MAX_PIXELS
from ssa_nerfstudio.errors import InputError

Kind = Literal["images", "masks", "depths"]
"""Kinds of files whose copies at 1 / N of the size nerfstudio finds in images_N, masks_N and depths_N."""
Split = Literal["train", "val", "test"]
"""nerfstudio's splits; the key in transforms.json is NAME_filenames."""
SPLITS: tuple[Split, ...] = ("train", "val", "test")
FILE_KEYS: dict[str, Kind] = {"file_path": "images", "mask_path": "masks", "depth_file_path": "depths"}
"""Keys of a frame that name a file."""
PERSPECTIVE_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"}
"""Values of camera_model that nerfstudio treats alike: OpenCV's pinhole camera."""
FISHEYE_MODELS = {"OPENCV_FISHEYE"}
OTHER_MODELS = {
    "EQUIRECTANGULAR",
    "OMNIDIRECTIONALSTEREO_L",
    "OMNIDIRECTIONALSTEREO_R",
    "VR180_L",
    "VR180_R",
    "ORTHOPHOTO",
    "FISHEYE624",
}
"""The rest of what nerfstudio knows. Splatfacto cannot undistort most of them."""
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_MAX_FLOAT32 = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Intrinsics:
    """The camera of one frame, as transforms.json states it for the photos of full size."""

    width: int
    height: int
    fx: float
    """Focal length along x, pixels; positive."""
    fy: float
    cx: float
    """Principal point, pixels from the left edge."""
    cy: float
    distortion: tuple[float, ...]
    """k1, k2, k3, k4, p1, p2; other camera models have other numbers of coefficients."""


@dataclass(frozen=True)
class Transforms:
    """A transforms.json whose structure and intrinsics are valid. No photo has been opened."""

    path: Path
    """The .json file."""
    meta: dict[str, Any]
    """Its contents."""

    @classmethod
    def read(cls, data: Path) -> Transforms:
        """Read the file and check what every use of it needs: frames with file names, camera model and intrinsics.

        Args:
            data: the dataset's folder, or its .json file.

        Raises:
            InputError: the file is missing, unreadable, no JSON, or one of these is missing or wrong.
        """
        path = data if data.suffix == ".json" else data / "transforms.json"
        if not path.is_file():
            raise InputError(f"{path} does not exist", "choose a folder that ns-process-data or ssa process made")
        try:
            meta = json.loads(read_text(path))
        except InputError:
            raise
        except OSError as error:
            raise InputError(f"{path} cannot be read ({error.strerror})", "check its permissions") from error
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path} is no valid JSON ({error})", "write it again with ns-process-data") from error
        result = cls(path, meta)
        result._check_frames()
        result._make_relative()
        result._check_cameras()
        return result

    @property
    def root(self) -> Path:
        """Folder that file names are relative to."""
        return self.path.parent

    @property
    def frames(self) -> list[dict[str, Any]]:
        """The frames in the order of the file. nerfstudio sorts them by path."""
        return self.meta["frames"]

    @property
    def camera_model(self) -> str:
        """Which lens model the intrinsics are of; one for all frames."""
        return self.meta.get("camera_model", "OPENCV")

    @property
    def test_photos_are_clean(self) -> bool:
        """Whether the file states a test split, whose photos are then free of the artifact.

        Without one, nerfstudio holds back some of the photos, which have the artifact, too.
        """
        return self.stated_split("test") is not None

    def intrinsics(self, frame: dict[str, Any]) -> Intrinsics:
        """Intrinsics of one frame; what the file states for all frames takes precedence, as in nerfstudio.

        Raises:
            ValueError: a value is missing, no number, not finite or out of range.
        """

        def value(key: str) -> float:
            if key not in self.meta and key not in frame:
                raise ValueError(f"{key} is missing")
            return _number(key, self.meta[key] if key in self.meta else frame[key])

        # nerfstudio takes all of the distortion from one place, and does not look for k4 to find it.
        stated = {*_DISTORTION, "distortion_params"} - {"k4"}
        holder = self.meta if stated & self.meta.keys() else frame
        distortion = holder.get("distortion_params") or [holder.get(key, 0.0) for key in _DISTORTION]
        if not isinstance(distortion, list):
            raise ValueError(f"distortion_params must be a list, got {distortion!r:.40}")
        numbers = {key: value(key) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        coefficients = tuple(_number("distortion", number) for number in distortion)
        for key, number in [*numbers.items(), *(("distortion", number) for number in coefficients)]:
            if not abs(number) <= _MAX_FLOAT32:
                raise ValueError(f"intrinsics must be finite, {key} is {number}")
        width, height, fx, fy, cx, cy = numbers.values()
        if min(width, height) < 1:
            raise ValueError(f"frame must be at least 1 x 1 pixels, got {width:g} x {height:g}")
        if width * height > MAX_PIXELS:
            raise ValueError(f"{width:.0f} x {height:.0f} are more than {MAX_PIXELS / 1e6:.0f} megapixels")
        if not min(np.float32(fx), np.float32(fy)) > 0:  # as nerfstudio reads them
            raise ValueError(f"focal lengths must be positive, got {fx:g} and {fy:g}")
        return Intrinsics(int(width), int(height), fx, fy, cx, cy, coefficients)

    def lens(self, frame: dict[str, Any], downscale_factor: int = 1) -> Lens:
        """The raw frame's lens at the resolution that is read.

        Raises:
            ValueError: see `intrinsics`; or nerfstudio cannot undistort photos of such a lens.
        """
        i, n = self.intrinsics(frame), downscale_factor
        if any(i.distortion) and self.camera_model not in PERSPECTIVE_MODELS | FISHEYE_MODELS:
            raise ValueError(f"camera_model {self.camera_model} with distortion cannot be used by splatfacto")
        distortion = i.distortion if any(i.distortion) else (0.0,) * 6
        model = "fisheye" if self.camera_model in FISHEYE_MODELS else "perspective"
        return Lens(int(i.width / n), int(i.height / n), i.fx / n, i.fy / n, i.cx / n, i.cy / n, distortion, model)

    def source(self, name: str, kind: Kind = "images", downscale_factor: int = 1) -> Path:
        """File of a photo, mask or depth map, found as nerfstudio finds it.

        Args:
            name: the path that transforms.json states.
            kind: what it is.
            downscale_factor: N > 1 reads images_N.
        """
        if downscale_factor == 1:
            return self.root / name
        return self.root / f"{kind}_{downscale_factor}" / PurePosixPath(name).name

    def stated_split(self, split: Split) -> list[str] | None:
        """Frames of a split, as their frames spell them; None where the file does not state it.

        Raises:
            InputError: it is no list of file names, or names a frame that does not exist.
        """
        key = f"{split}_filenames"
        if key not in self.meta:
            return None
        names = self.meta[key]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{self.path}: {key} must be a list of file paths", "correct or remove it")
        spelling = {Path(frame["file_path"]): frame["file_path"] for frame in self.frames}
        for name in names:
            if Path(name) not in spelling:
                raise InputError(f"{self.path}: {key} has {name}, which no frame is", "remove it there")
        return [spelling[Path(name)] for name in names]

    def check_exist(self, names: Iterable[str], kind: Kind = "images", downscale_factor: int = 1) -> None:
        """Check that photos or masks exist.

        Args:
            names: paths that transforms.json states.
            kind: what they are.
            downscale_factor: N > 1 looks in images_N.

        Raises:
            InputError: one does not exist.
        """
        for name in names:
            path = self.source(name, kind, downscale_factor)
            if not is_file(path):
                what = "mask" if kind == "masks" else "photo"
                raise InputError(f"{path} does not exist", f"put the {what} there or remove its frame")

    def check_copyable(self, others: Iterable[str] = ()) -> None:
        """Check what a copy of the dataset needs beyond training: each frame once, and all files inside the folder.

        Args:
            others: further names of files in the folder.

        Raises:
            InputError: it is not so.
        """
        seen = set()
        for photo in (Path(frame["file_path"]) for frame in self.frames):
            if photo in seen:
                raise InputError(f"{self.path} has two frames of {photo}", "remove one")
            seen.add(photo)
        for name in [*(frame[key] for frame in self.frames for key in FILE_KEYS if key in frame), *others]:
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
                raise InputError(
                    f"{self.path}: {name} lies outside the dataset", "put it inside and state its relative path"
                )

    def _check_frames(self) -> None:
        problem = f"{self.path} has no list 'frames' of objects with a file_path"
        frames = self.meta.get("frames") if isinstance(self.meta, dict) else None
        if not isinstance(frames, list):
            raise InputError(problem, "write it again with ns-process-data")
        for frame in frames:
            if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
                raise InputError(f"{problem}: the frame {frame!r:.100} is no such object", "correct or remove it")
        stated = [(key, frame[key]) for frame in frames for key in FILE_KEYS if key in frame]
        for key, name in [*stated, ("ply_file_path", self.meta.get("ply_file_path", ""))]:
            if not isinstance(name, str):
                raise InputError(f"{self.path}: {key} {name!r:.40} is no file path", "correct or remove it")

    def _make_relative(self) -> None:
        """Take absolute paths inside the dataset, which some programs write, for relative ones."""
        roots = self.root.absolute(), self.root.resolve()

        def relative(name: object) -> object:
            if not isinstance(name, str) or not name.startswith(tuple(f"{root}/" for root in roots)):
                return name
            return next(str(PurePosixPath(name).relative_to(root)) for root in roots if name.startswith(f"{root}/"))

        keys = [(self.meta, "ply_file_path"), *((frame, key) for frame in self.frames for key in FILE_KEYS)]
        for holder, key in keys:
            if key in holder:
                holder[key] = relative(holder[key])
        for key in (f"{split}_filenames" for split in SPLITS):
            if isinstance(self.meta.get(key), list):
                self.meta[key] = [relative(name) for name in self.meta[key]]

    def _check_cameras(self) -> None:
        known = PERSPECTIVE_MODELS | FISHEYE_MODELS | OTHER_MODELS
        if not isinstance(self.camera_model, str) or self.camera_model not in known:
            raise InputError(
                f"{self.path}: camera_model {self.camera_model!r} is none of {', '.join(sorted(known))}",
                "correct it, or remove it where photos are from a perspective camera",
            )
        for frame in self.frames:
            try:
                self.intrinsics(frame)
            except ValueError as error:
                raise InputError(
                    f"{self.path}: camera of {frame['file_path']}: {error}", "correct it or process the photos again"
                ) from error


def _number(key: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{key} is no number: {value!r:.40}") from error


def is_file(path: Path) -> bool:
    """Whether there is such a file; False where no file can have that name.

    Raises:
        PermissionError: a folder on the way to it may not be entered.
    """
    try:
        return path.is_file()
    except PermissionError:
        raise
    except OSError:  # a name that is too long
        return False
