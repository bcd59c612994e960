"""A nerfstudio dataset at one resolution: views with their lenses, and the split into training and test."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ssa_nerfstudio.cameras.lens import Lens, undistorted_lens
from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.data.transforms import FILE_KEYS, SPLITS, Kind, Transforms
from ssa_nerfstudio.errors import InputError

_COLMAP_MODEL = "colmap/sparse/0"


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
    """A dataset at one resolution; photos are not opened."""

    transforms: Transforms
    """Its transforms.json."""
    downscale_factor: int
    """N where photos are read from images_N (masks from masks_N, depths from depths_N), else 1."""
    eval_interval: int
    """Every so many views one is a test view, in sorted order, where transforms.json states no split."""

    @classmethod
    def read(cls, data: Path, eval_interval: int, downscale_factor: int = 1) -> Dataset:
        """Read transforms.json and check all that can be checked without opening a photo; poses are not read.

        Args:
            data: the dataset's folder, or its .json file.
            eval_interval: at least 2.
            downscale_factor: at least 1.

        Raises:
            InputError: transforms.json is missing or broken, a photo is missing, or the split cannot be used.
        """
        if eval_interval < 2:
            raise InputError(f"the interval of test views must be at least 2, got {eval_interval}")
        if downscale_factor < 1:
            raise InputError(f"the downscale factor must be at least 1, got {downscale_factor}", "2 reads images_2")
        dataset = cls(Transforms.read(data), downscale_factor, eval_interval)
        dataset._check()
        return dataset

    @property
    def root(self) -> Path:
        """Folder that file paths are relative to."""
        return self.transforms.root

    @property
    def meta(self) -> dict[str, Any]:
        """Contents of transforms.json."""
        return self.transforms.meta

    @cached_property
    def views(self) -> list[View]:
        """All views in nerfstudio's order, which is that of their paths."""
        frames = sorted(self.transforms.frames, key=lambda frame: Path(frame["file_path"]))
        train, val, test = self.split
        roles: dict[str, Literal["train", "test"]] = dict.fromkeys(train, "train")
        roles |= dict.fromkeys([*val, *test], "test")
        return [
            View(
                path=frame["file_path"],
                role=roles.get(frame["file_path"], "unused"),
                lens=self.transforms.lens(frame, self.downscale_factor),
                companions=tuple(
                    (kind, frame[key]) for key, kind in FILE_KEYS.items() if kind != "images" and key in frame
                ),
            )
            for frame in frames
        ]

    @cached_property
    def split(self) -> tuple[list[str], list[str], list[str]]:
        """Paths of training, validation and test views.

        As transforms.json has them, what is missing there completed: validation views serve as test views and vice
        versa, and the remaining views are training views. Where it has none, nerfstudio's interval split: in sorted
        order the views 0, n, 2n, ... are for both validation and test, the others for training.
        """
        paths = sorted((frame["file_path"] for frame in self.transforms.frames), key=Path)
        if self.split_by_interval:
            test = paths[:: self.eval_interval]
            return _without(paths, test), test, test
        train, val, test = (self.transforms.stated_split(split) for split in SPLITS)
        val, test = (test if val is None else val), (val if test is None else test)
        if train is None:
            train = _without(paths, [*(val or []), *(test or [])])
        if val is None or test is None:
            val = test = _without(paths, train)
        return train, val, test

    @property
    def split_by_interval(self) -> bool:
        """Whether transforms.json states no split."""
        return not any(f"{split}_filenames" in self.meta for split in SPLITS)

    @property
    def points(self) -> list[str]:
        """Files of the sparse points, relative to `root`.

        Where an older dataset lacks the .ply or the transform that was applied, nerfstudio reads COLMAP's model.
        """
        stated = [self.meta["ply_file_path"]] if "ply_file_path" in self.meta else []
        if stated and "applied_transform" in self.meta:
            return stated
        model = sorted(path for path in (self.root / _COLMAP_MODEL).glob("*") if path.is_file())
        return stated + [f"{_COLMAP_MODEL}/{path.name}" for path in model]

    def source(self, path: str, kind: Kind = "images") -> Path:
        """File of a photo, mask or depth map at the resolution that is read."""
        return self.transforms.source(path, kind, self.downscale_factor)

    def read_photo(self, view: View) -> np.ndarray:
        """Decode a view's photo, ignoring its EXIF orientation as nerfstudio does: uint8 [H, W, 3], writable.

        Raises:
            InputError: see `photos.read_photo`.
        """
        return read_photo(self.source(view.path), (view.lens.width, view.lens.height))

    def _check(self) -> None:
        for frame in self.transforms.frames:
            try:
                undistorted_lens(self.transforms.lens(frame, self.downscale_factor))
            except ValueError as error:
                raise InputError(
                    f"{self.transforms.path}: camera of {frame['file_path']}: {error}", "process the photos again"
                ) from error
        self.transforms.check_copyable(self.points)
        train, val, test = self.split
        for both in sorted({*train} & {*val, *test}):
            raise InputError(
                f"{self.transforms.path}: {both} is both training and test view",
                "list it once: test views stay without an artifact",
            )
        if not train:
            raise InputError(
                f"{self.transforms.path} leaves no photo to train on", "add photos or hold fewer back for evaluation"
            )
        self.transforms.check_exist((view.path for view in self.views), downscale_factor=self.downscale_factor)


def _without(paths: list[str], others: list[str]) -> list[str]:
    excluded = {*others}
    return [path for path in paths if path not in excluded]
