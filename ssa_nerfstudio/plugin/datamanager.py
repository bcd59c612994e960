"""Photos are decoded, undistorted and cached once; cameras are prepared once, so that a step only picks one.

nerfstudio undistorts perspective photos when it caches them; fisheye ones are undistorted before, as in `cameras.lens`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers import full_images_datamanager
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio.cameras.lens import undistort, undistorted_lens
from ssa_nerfstudio.data.photos import check_mask, read_photo
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.camera_matching import fisheye_lenses
from ssa_nerfstudio.plugin.view_geometry import metadata, prepare

TRAINING_REDUCTIONS = (1, 2, 4, 8)
"""Factors by which splatfacto's resolution schedule reduces photos, for which intrinsics are kept ready."""
MAX_DECODING_THREADS = 16
"""Each holds a photo and its undistortion, a tenth of a gigabyte for 12 megapixels."""


class PhotoDataset(InputDataset):
    """nerfstudio's dataset, with our decoder: pixels that it would misread are refused, and errors name the file.

    Fisheye photos and their cameras leave it as perspective ones.
    """

    raw_cameras: Cameras
    """Cameras of the photos as they were taken, at the resolution that is trained on."""

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        super().__init__(dataparser_outputs, scale_factor)
        self.raw_cameras = deepcopy(self.cameras)
        self._fisheyes = fisheye_lenses(self.raw_cameras)
        for index, raw in self._fisheyes.items():
            target = undistorted_lens(raw)
            for name in ("fx", "fy", "cx", "cy"):
                getattr(self.cameras, name)[index] = getattr(target, name)
            self.cameras.camera_type[index] = CameraType.PERSPECTIVE.value
            if self.cameras.distortion_params is not None:
                self.cameras.distortion_params[index] = 0

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """Decode one photo and scale it by `scale_factor`: uint8 [H, W, 3], or [H, W, 4] for RGBA.

        Raises:
            InputError: less than a pixel is left, or see `read_photo`.
        """
        photo = read_photo(self.image_filenames[image_idx], self._stored_size(image_idx), alpha=True)
        if self.scale_factor == 1.0:
            return photo
        image = Image.fromarray(photo)
        size = int(image.width * self.scale_factor), int(image.height * self.scale_factor)
        if min(size) < 1:
            raise InputError(
                f"--pipeline.datamanager.camera-res-scale-factor {self.scale_factor:g} leaves less than a pixel of "
                f"{self.image_filenames[image_idx]}",
                "choose a larger one",
            )
        return np.array(image.resize(size, Image.Resampling.BILINEAR))

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict:
        """Photo and mask of one view, as upstream gives them.

        Raises:
            InputError: see `read_photo` and `check_mask`.
        """
        masks = self._dataparser_outputs.mask_filenames
        if masks is not None:
            check_mask(masks[image_idx], self._stored_size(image_idx))
        data = super().get_data(image_idx, image_type)
        if (raw := self._fisheyes.get(image_idx)) is not None:
            data["image"] = torch.from_numpy(undistort(data["image"].numpy(), raw))
            if "mask" in data:
                data["mask"] = torch.from_numpy(undistort(data["mask"].numpy().astype(np.float32), raw) > 0.5)
        return data

    def _stored_size(self, image_idx: int) -> tuple[int, int]:
        """Width and height of a photo before `scale_factor`."""
        cameras = self._dataparser_outputs.cameras
        return int(cameras.width[image_idx]), int(cameras.height[image_idx])


@dataclass
class SSADatamanagerConfig(FullImageDatamanagerConfig):
    """Configuration of `SSADatamanager`."""

    _target: type = field(default_factory=lambda: SSADatamanager)
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """Type of the cached photos; uint8 is exact for 8-bit photos and a quarter of the memory."""


class SSADatamanager(FullImageDatamanager[PhotoDataset]):
    """`FullImageDatamanager` that also works without CUDA, decodes by `PhotoDataset`, and prepares its cameras once."""

    config: SSADatamanagerConfig
    _train_views: list[Cameras] | None = None

    def __init__(self, config: SSADatamanagerConfig, *args: Any, **kwargs: Any) -> None:
        try:
            super().__init__(config, *args, **kwargs)
        except AssertionError as error:  # how nerfstudio's readers of datasets refuse one
            data = config.data or config.dataparser.data
            why = f" ({error})" if str(error) else ""
            raise InputError(f"nerfstudio cannot read {data}{why}", "look at the options of its reader") from error

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]):
        if not torch.cuda.is_available():
            # Upstream pins memory for "cpu", which needs CUDA; "gpu" means the training device, here the CPU.
            cache_images_device = "gpu"
        try:
            with _more_decoding_threads():
                return super()._load_images(split, cache_images_device)
        except AssertionError as error:
            raise InputError(f"{error}", "write w and h in transforms.json as the photos are") from error

    @property
    def folder(self) -> Path:
        """Of the dataset."""
        data = Path(self.config.data or self.config.dataparser.data)
        return data.parent if data.suffix == ".json" else data

    def photo_names(self, dataset: PhotoDataset) -> list[str]:
        """Paths of a split's photos relative to the dataset."""
        return [Path(os.path.relpath(path, self.folder)).as_posix() for path in dataset.image_filenames]

    @property
    def fixed_indices_eval_dataloader(self) -> list[tuple[Cameras, dict]]:  # type: ignore[override]
        """Cameras and photos of all test views; the cameras' metadata name the photos."""
        names = self.photo_names(self.eval_dataset)
        return [_named(camera, data, names) for camera, data in super().fixed_indices_eval_dataloader]

    def next_eval_image(self, step: int) -> tuple[Cameras, dict]:
        """One test view, likewise."""
        return _named(*super().next_eval_image(step), self.photo_names(self.eval_dataset))

    def next_train(self, step: int) -> tuple[Cameras, dict]:
        """Camera and photo of one training view; every view once before any comes again.

        The camera's metadata hold what `view_geometry.prepare` put there.
        """
        photos = self.cached_train
        if self._train_views is None:
            self._train_views = prepare(self.train_cameras.to(self.device), TRAINING_REDUCTIONS)
        index = self.train_unseen_cameras.pop(0)
        if not self.train_unseen_cameras:
            self.train_unseen_cameras = self.sample_train_cameras()
        data = photos[index].copy()
        data["image"] = data["image"].to(self.device, non_blocking=True)
        return self._train_views[index], data


@contextmanager
def _more_decoding_threads() -> Iterator[None]:
    """Let upstream decode and undistort photos in more threads than two; for one caller at a time."""
    upstream: Any = full_images_datamanager
    former, threads = upstream.ThreadPoolExecutor, min(MAX_DECODING_THREADS, usable_cores())
    upstream.ThreadPoolExecutor = lambda max_workers: former(max(max_workers, threads))
    try:
        yield
    finally:
        upstream.ThreadPoolExecutor = former


def _named(camera: Cameras, data: dict, names: list[str]) -> tuple[Cameras, dict]:
    """The view, whose camera's metadata name its photo."""
    camera.metadata = {**metadata(camera), "photo": names[data["image_idx"]]}
    return camera, data
