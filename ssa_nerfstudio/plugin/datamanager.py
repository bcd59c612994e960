"""Photos are decoded, undistorted and cached once; cameras are prepared once, so that a step only picks one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image

from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.view_geometry import prepare

TRAINING_REDUCTIONS = (1, 2, 4, 8)
"""Factors by which splatfacto's resolution schedule reduces photos, for which intrinsics are kept ready."""


class PhotoDataset(InputDataset):
    """nerfstudio's dataset, with our decoder: pixels that it would misread are refused, and errors name the file."""

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """Decode one photo and scale it by `scale_factor`: uint8 [H, W, 3], or [H, W, 4] for RGBA.

        Raises:
            InputError: see `read_photo`.
        """
        cameras = self._dataparser_outputs.cameras  # unlike self.cameras as they were before any scaling
        size = int(cameras.width[image_idx]), int(cameras.height[image_idx])
        scaled = self.scale_factor != 1.0
        photo = read_photo(self.image_filenames[image_idx], None if scaled else size, alpha=True)
        if not scaled:
            return photo
        image = Image.fromarray(photo)
        size = int(image.width * self.scale_factor), int(image.height * self.scale_factor)
        return np.array(image.resize(size, Image.Resampling.BILINEAR))


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

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]):
        if not torch.cuda.is_available():
            # Upstream pins memory for "cpu", which needs CUDA; "gpu" means the training device, here the CPU.
            cache_images_device = "gpu"
        try:
            return super()._load_images(split, cache_images_device)
        except AssertionError as error:
            raise InputError(f"{error}", "write w and h in transforms.json as the photos are") from error

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
