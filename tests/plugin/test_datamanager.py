"""How photos are cached."""

from __future__ import annotations

from threading import Barrier

import numpy as np
import pytest
import torch
from nerfstudio.data.datamanagers import full_images_datamanager
from PIL import Image

from ssa_nerfstudio.plugin import datamanager
from ssa_nerfstudio.plugin.datamanager import PhotoDataset

CORES = 4


@pytest.fixture
def manager(tiny_scene, tmp_path, configure_training):
    """A datamanager that has read no photo yet."""
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 1)
    return config.pipeline.datamanager.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)


def test_photos_are_decoded_on_all_cores_and_stay_in_order(manager, monkeypatch):
    """Nobody passes the barrier before as many threads as there are cores wait at it."""
    monkeypatch.setattr(datamanager, "usable_cores", lambda: CORES)
    together, decode = Barrier(CORES, timeout=30), PhotoDataset.get_numpy_image

    def decode_together(self, index: int) -> np.ndarray:
        if index < CORES:
            together.wait()
        return decode(self, index)

    monkeypatch.setattr(PhotoDataset, "get_numpy_image", decode_together)
    upstream = full_images_datamanager.ThreadPoolExecutor  # pyright: ignore[reportPrivateImportUsage]
    photos = manager.cached_train
    for photo, path in zip(photos, manager.train_dataset.image_filenames, strict=True):
        assert torch.equal(photo["image"].cpu(), torch.from_numpy(np.array(Image.open(path).convert("RGB"))))
    assert full_images_datamanager.ThreadPoolExecutor is upstream  # pyright: ignore[reportPrivateImportUsage]


def test_a_photo_that_cannot_be_decoded_leaves_upstream_as_it_was(manager, monkeypatch):
    upstream = full_images_datamanager.ThreadPoolExecutor  # pyright: ignore[reportPrivateImportUsage]
    monkeypatch.setattr(PhotoDataset, "get_numpy_image", lambda self, index: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        _ = manager.cached_train
    assert full_images_datamanager.ThreadPoolExecutor is upstream  # pyright: ignore[reportPrivateImportUsage]
