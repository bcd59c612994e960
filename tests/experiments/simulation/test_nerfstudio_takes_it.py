"""nerfstudio loads what the simulator writes, and `overlay: given` takes the layers as they are."""

from __future__ import annotations

import numpy as np
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from small_datasets import pixels, write_dataset

from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.plugin.camera_matching import group_cameras
from ssa_nerfstudio.plugin.datamanager import SSADatamanager, SSADatamanagerConfig
from ssa_nerfstudio.plugin.overlay_setup import given_overlays


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_given_layers_explain_the_photos_that_the_model_sees(model, tmp_path):
    data = write_dataset(tmp_path / "data", width=96, height=72, k1=-0.15, k2=0.02, camera_model=model)
    clean, corrupted = tmp_path / "clean", tmp_path / "corrupted"
    for output, effects in ((clean, []), (corrupted, ["rain", "finger", "dashboard"])):
        main(["simulate", "--data", str(data), "--output", str(output), "--effects", *effects])
    views = {}
    for folder in (clean, corrupted):
        config = SSADatamanagerConfig(data=folder, dataparser=NerfstudioDataParserConfig(load_3D_points=False))
        manager = SSADatamanager(config, device="cpu")
        views[folder] = [photo["image"].numpy() for photo in manager.cached_train]
        keys, groups = group_cameras(manager.train_dataset.cameras)
        assert len(manager.eval_dataset) == 2
        assert len(groups) == 8
    sizes = [(int(key[1]), int(key[0])) for key in keys]
    (overlay,) = given_overlays(corrupted / "layers/undistorted.npz", sizes)
    transmittance, addition = (layer.numpy() for layer in overlay.layers())
    for before, after in zip(views[clean], views[corrupted], strict=True):
        formed = (transmittance * (before / 255) + addition).clip(0, 1) * 255
        # The finger's light differs from view to view by more than the rest deviates.
        assert np.abs(formed - after).mean() < 2
        assert np.abs(before.astype(float) - after).mean() > 15


def test_the_split_is_nerfstudios_own(tmp_path):
    data = write_dataset(tmp_path / "data", views=23)
    for interval in (2, 5, 8):
        train, val, test = Dataset.read(data, interval).split
        parser = NerfstudioDataParserConfig(data=data, eval_mode="interval", eval_interval=interval).setup()
        for split, ours in (("train", train), ("val", val), ("test", test)):
            theirs = parser.get_dataparser_outputs(split).image_filenames
            assert [data / path for path in ours] == theirs


def test_real_captures(captures, tmp_path):
    """The command as a user types it; photos of a size and number that occur."""
    output = tmp_path / "out"
    main(["simulate", "--data", str(captures / "gopro_walk"), "--output", str(output), "--scene", "dashcam-in-rain"])
    parser = NerfstudioDataParserConfig(data=output).setup()
    train, test = (parser.get_dataparser_outputs(split) for split in ("train", "test"))
    assert (len(train.image_filenames), len(test.image_filenames)) == (65, 10)
    assert (pixels(train.image_filenames[0])[-20:] == pixels(train.image_filenames[40])[-20:]).all()
    for path in test.image_filenames:
        assert path.read_bytes() == (captures / "gopro_walk/images" / path.name).read_bytes()
