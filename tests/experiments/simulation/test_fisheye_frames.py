"""`ssa simulate` on fisheye photos: effects are drawn in the raw frame, and nothing outside of the image circle."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_datasets import pixels, write_dataset
from wide_captures import fisheye, panorama_poses

from ssa_nerfstudio.cameras.lens import Lens, undistort
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS

SIZE, FOCAL = 96, 28.0
RADIUS = FOCAL * np.pi / 2


@pytest.fixture(scope="module")
def data(tmp_path_factory, trace_built_in_scene) -> Path:
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "camera_model": "OPENCV_FISHEYE"}
    folder = write_dataset(tmp_path_factory.mktemp("data") / "d", 9, SIZE, SIZE, ".png", **lens)
    for number, pose in enumerate(panorama_poses(9)):
        photo = fisheye(trace_built_in_scene, pose, SIZE, FOCAL)
        Image.fromarray(photo).save(folder / f"images/frame_{number:03d}.png")
    return folder


@pytest.mark.parametrize("effect", sorted(EFFECTS))
def test_nothing_is_drawn_outside_of_the_image_circle(data, tmp_path, effect):
    main(["simulate", "--data", str(data), "--output", str(tmp_path / "out"), "--effects", effect])
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    distance = np.hypot(x - SIZE / 2, y - SIZE / 2)
    layers = np.load(tmp_path / "out/layers/raw.npz")
    outside = distance > RADIUS + 2
    assert (layers["T"][outside] == 1).all()
    assert not layers["B"][outside].any()
    changed = np.abs(1 - layers["T"]).max(axis=-1) + layers["B"].max(axis=-1) > 0.02
    assert changed[distance < RADIUS - 1].any()
    for photo in json.loads((tmp_path / "out/transforms.json").read_text())["train_filenames"][:3]:
        assert not pixels(tmp_path / "out" / photo)[outside].any()


def test_effects_are_those_of_the_raw_frame_inside(data, tmp_path, draw_effect):
    main(["simulate", "--data", str(data), "--output", str(tmp_path / "out"), "--effects", "dashboard"])
    drawn = draw_effect("dashboard", SIZE, SIZE)
    layers = np.load(tmp_path / "out/layers/raw.npz")
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    inside = np.hypot(x - SIZE / 2, y - SIZE / 2) < RADIUS - 2
    assert np.array_equal(layers["T"][inside], drawn.transmittance[inside])
    lens = Lens(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, model="fisheye")
    undistorted = np.load(tmp_path / "out/layers/undistorted.npz")
    assert np.array_equal(undistorted["B"], undistort(layers["B"], lens))
