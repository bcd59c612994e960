"""A nerfstudio dataset as its transforms.json tells it: views, lenses and the split into training and test."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from ssa_nerfstudio.cameras.lens import Lens, undistorted
from ssa_nerfstudio.errors import InputError

Kind = Literal["images", "masks", "depths"]
"""Folders whose copies of 1 / N of the size nerfstudio finds in images_N, masks_N and depths_N."""
_FISHEYE = {"OPENCV_FISHEYE"}
_PERSPECTIVE = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"}
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_COMPANIONS: tuple[tuple[Kind, str], ...] = (("masks", "mask_path"), ("depths", "depth_file_path"))
_COLMAP_MODEL = "colmap/sparse/0"
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")


@dataclass(frozen=True)
class View:
    """One photo of the dataset."""

    path: str
    """As transforms.json states it, relative to the dataset."""
    role: Literal["train", "test", "unused"]
    """Test includes validation; nerfstudio never opens an unused view."""
    lens: Lens
    """The raw frame, at the resolution that is read."""
    companions: tuple[tuple[Kind, str], ...]
    """Mask and depth map that belong to it, with their paths as transforms.json states them."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the raw frame, pixels."""
        return self.lens.height, self.lens.width


@dataclass(frozen=True)
class Dataset:
    """A dataset at one resolution, read from its transforms.json; photos are not opened."""

    root: Path
    """Folder that file paths are relative to."""
    meta: dict[str, Any]
    """transforms.json."""
    downscale_factor: int
    """N where photos are read from images_N (masks from masks_N, depths from depths_N), else 1."""
    eval_interval: int
    """Every so many views one is a test view, in sorted order, where transforms.json states no split."""

    @classmethod
    def read(cls, data: Path, eval_interval: int, downscale_factor: int = 1) -> Dataset:
        """Reads transforms.json and checks all that can be checked without opening a photo.

        Args:
            data: the dataset's folder, or its .json file.
            eval_interval: at least 2.
            downscale_factor: at least 1.

        Raises:
            InputError: transforms.json is missing or broken, a photo is missing, or the split cannot be used.
        """
        path = data if data.suffix == ".json" else data / "transforms.json"
        if not path.is_file():
            raise InputError(f"{path} does not exist", "give --data a folder that ns-process-data made")
        if eval_interval < 2:
            raise InputError(f"--eval-interval must be at least 2, got {eval_interval}", "8 tests every 8th photo")
        if downscale_factor < 1:
            raise InputError(f"--downscale-factor must be at least 1, got {downscale_factor}", "2 reads images_2")
        try:
            meta = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{path} is no valid JSON ({error})", "write it again with ns-process-data") from error
        frames = meta.get("frames") if isinstance(meta, dict) else None
        if not isinstance(frames, list) or not all(
            isinstance(frame, dict) and isinstance(frame.get("file_path"), str) for frame in frames
        ):
            raise InputError(
                f"{path} has no list 'frames' of photos with a file_path", "write it again with ns-process-data"
            )
        dataset = cls(path.parent, meta, downscale_factor, eval_interval)
        dataset._check(path)
        return dataset

    @cached_property
    def views(self) -> list[View]:
        """All views in nerfstudio's order, which is that of their paths."""
        frames = sorted(self.meta["frames"], key=lambda frame: Path(frame["file_path"]))
        train, val, test = self.split
        roles: dict[str, Literal["train", "test"]] = dict.fromkeys(train, "train")
        roles |= dict.fromkeys([*val, *test], "test")
        return [
            View(
                path=frame["file_path"],
                role=roles.get(frame["file_path"], "unused"),
                lens=self._lens(frame),
                companions=tuple((kind, frame[key]) for kind, key in _COMPANIONS if key in frame),
            )
            for frame in frames
        ]

    @cached_property
    def split(self) -> tuple[list[str], list[str], list[str]]:
        """Paths of training, validation and test views.

        As transforms.json has them, what is missing there completed: validation and test stand for one another, and
        the remaining views are training views. Where it has none, nerfstudio's interval split: in sorted order the
        views 0, n, 2n, ... are for both validation and test, the others for training.
        """
        paths = sorted((frame["file_path"] for frame in self.meta["frames"]), key=Path)
        given = {name: self._known(name, paths) for name in _SPLITS if name in self.meta}
        if self.split_by_interval:
            test = paths[:: self.eval_interval]
            return _without(paths, test), test, test
        train = given.get("train_filenames")
        val = given.get("val_filenames", given.get("test_filenames"))
        test = given.get("test_filenames", val)
        if train is None:
            train = _without(paths, [*(val or []), *(test or [])])
        if val is None or test is None:
            val = test = _without(paths, train)
        return train, val, test

    @property
    def split_by_interval(self) -> bool:
        """Whether transforms.json states no split."""
        return not any(name in self.meta for name in _SPLITS)

    @property
    def points(self) -> list[str]:
        """Files of the sparse points, relative to `root`.

        Where an older dataset lacks the .ply or the transform that was applied, nerfstudio looks at COLMAP's model.
        """
        stated = [self.meta["ply_file_path"]] if "ply_file_path" in self.meta else []
        if stated and "applied_transform" in self.meta:
            return stated
        model = sorted(path for path in (self.root / _COLMAP_MODEL).glob("*") if path.is_file())
        return stated + [f"{_COLMAP_MODEL}/{path.name}" for path in model]

    def source(self, path: str, kind: Kind = "images") -> Path:
        """File of a photo, mask or depth map at the resolution that is read, found as nerfstudio finds it."""
        if self.downscale_factor == 1:
            return self.root / path
        return self.root / f"{kind}_{self.downscale_factor}" / PurePosixPath(path).name

    def _known(self, split: str, paths: list[str]) -> list[str]:
        """The frames' own spelling of the names in a list of transforms.json."""
        spelling = {Path(path): path for path in paths}
        if not isinstance(self.meta[split], list) or not all(isinstance(name, str) for name in self.meta[split]):
            raise InputError(f"{self.root}/transforms.json: {split} must be a list of file paths", "mend or remove it")
        for name in self.meta[split]:
            if Path(name) not in spelling:
                raise InputError(
                    f"{self.root}/transforms.json: {split} has {name}, which no frame is", "remove it there"
                )
        return [spelling[Path(name)] for name in self.meta[split]]

    def _lens(self, frame: dict[str, Any]) -> Lens:
        def value(key: str) -> float:
            if key not in self.meta and key not in frame:
                raise ValueError(f"{key} is missing")
            return float(self.meta[key] if key in self.meta else frame[key])

        model = self.meta.get("camera_model", "OPENCV")
        # nerfstudio takes all of the distortion from one place, and does not look for k4 to find it.
        stated = {*_DISTORTION, "distortion_params"} - {"k4"}
        source = self.meta if stated & self.meta.keys() else frame
        distortion = tuple(source.get("distortion_params") or (source.get(key, 0.0) for key in _DISTORTION))
        if model not in _FISHEYE | _PERSPECTIVE and any(distortion):
            raise ValueError(f"camera_model {model} with distortion is none that splatfacto trains on")
        n = self.downscale_factor
        return Lens(
            width=int(value("w") / n),
            height=int(value("h") / n),
            fx=value("fl_x") / n,
            fy=value("fl_y") / n,
            cx=value("cx") / n,
            cy=value("cy") / n,
            distortion=tuple(float(number) for number in distortion),
            model="fisheye" if model in _FISHEYE else "perspective",
        )

    def _check(self, path: Path) -> None:
        for frame in self.meta["frames"]:
            try:
                undistorted(self._lens(frame))
            except (TypeError, ValueError) as error:
                raise InputError(
                    f"{path}: camera of {frame['file_path']}: {error}", "process the photos again"
                ) from error
        seen = set()
        for photo in (Path(frame["file_path"]) for frame in self.meta["frames"]):
            if photo in seen:
                raise InputError(f"{path} has two frames of {photo}", "remove one")
            seen.add(photo)
        train, val, test = self.split
        for both in sorted({*train} & {*val, *test}):
            raise InputError(f"{path}: {both} is both training and test view", "test views stay clean, list it once")
        if not train:
            raise InputError(f"{path} leaves no photo to train on", "add photos or hold fewer back for evaluation")
        names = [name for view in self.views for name in (view.path, *(name for _, name in view.companions))]
        for name in [*names, *self.points]:
            if not isinstance(name, str):
                raise InputError(f"{path}: {name!r} stands where a file's path is expected", "mend or remove it")
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
                raise InputError(
                    f"{path}: {name} lies outside the dataset", "put it inside and state its relative path"
                )
        for view in self.views:
            if not _is_file(self.source(view.path)):
                raise InputError(f"{self.source(view.path)} does not exist", "put the photo there or remove its frame")


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # no path: too long
        return False


def _without(paths: list[str], others: list[str]) -> list[str]:
    excluded = {*others}
    return [path for path in paths if path not in excluded]
