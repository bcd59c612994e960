"""OPENCV_FISHEYE from a dataset to exports: undistorted for training, and the artifact back in the raw frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from wide_captures import fisheye, panorama_poses

from ssa_nerfstudio.cameras.lens import Lens, distort, undistort, undistorted_lens
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.sparse_points import write_points
from ssa_nerfstudio.plugin.datamanager import SSADatamanager, SSADatamanagerConfig

VIEWS, SIZE, K1 = 12, 96, -0.02
FOCAL = SIZE / 2 / (np.pi / 2 * (1 + K1 * (np.pi / 2) ** 2))
LENS = Lens(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, (K1, 0, 0, 0, 0, 0), "fisheye")
PANEL = np.s_[56:72, 20:64]
COLOR = np.array([200, 60, 90], np.uint8)


@pytest.fixture(scope="module")
def capture(tmp_path_factory, trace_built_in_scene) -> Path:
    """Photos of 180 degrees with a panel in front of all of them, a mask each, and points on the scene's surfaces."""
    folder = tmp_path_factory.mktemp("fisheye") / "data"
    for kind in ("images", "masks"):
        (folder / kind).mkdir(parents=True)
    rng, points, colors, frames = np.random.default_rng(0), [], [], []
    for number, pose in enumerate(panorama_poses(2 * VIEWS)[:VIEWS]):
        photo = fisheye(trace_built_in_scene, pose, SIZE, FOCAL, K1).copy()
        photo[PANEL] = COLOR
        Image.fromarray(photo).save(folder / f"images/{number:02d}.png")
        Image.fromarray(np.arange(SIZE)[None].repeat(SIZE, 0) >= 30).save(folder / f"masks/{number:02d}.png")
        rays = rng.normal(size=(100, 3)) @ pose[:3, :3].T
        depth, color = trace_built_in_scene(pose[:3, 3], rays)
        points.append(pose[:3, 3] + depth[:, None] * rays)
        colors.append(np.rint(color * 255).astype(np.uint8))
        opengl = pose @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"images/{number:02d}.png", "transform_matrix": opengl.tolist()})
    write_points(folder / "points.ply", np.concatenate(points), np.concatenate(colors))
    lens = {"w": SIZE, "h": SIZE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2, "k1": K1, "k2": 0.0}
    meta = {"camera_model": "OPENCV_FISHEYE", **lens, "k3": 0.0, "k4": 0.0, "ply_file_path": "points.ply"}
    (folder / "transforms.json").write_text(json.dumps({**meta, "frames": frames}))
    return folder


def variant(capture: Path, name: str, masks: bool = False, **changes: float) -> Path:
    """A transforms.json beside the capture's that differs from it."""
    meta = json.loads((capture / "transforms.json").read_text()) | changes
    if masks:
        for frame in meta["frames"]:
            frame["mask_path"] = frame["file_path"].replace("images", "masks")
    (capture / name).write_text(json.dumps(meta))
    return capture / name


@pytest.mark.parametrize("k1", [K1, 0.0])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_training_sees_undistorted_photos_masks_and_cameras(capture, k1, scale):
    """Also of an ideal lens, whose photos nerfstudio takes for perspective ones."""
    data = variant(capture, f"{k1}-{scale}.json", masks=True, k1=k1)
    config = SSADatamanagerConfig(dataparser=NerfstudioDataParserConfig(data=data), camera_res_scale_factor=scale)
    manager = SSADatamanager(config, device="cpu")
    size = int(SIZE * scale)
    raw = Lens(size, size, FOCAL * scale, FOCAL * scale, size / 2, size / 2, (k1, 0, 0, 0, 0, 0), "fisheye")
    target = undistorted_lens(raw)
    view = manager.cached_train[3]
    name = Path(manager.train_dataset.image_filenames[3]).name
    photo = Image.open(capture / "images" / name)
    photo = np.asarray(photo if scale == 1 else photo.resize((size, size), Image.Resampling.BILINEAR))
    assert np.abs(view["image"].numpy().astype(int) - undistort(photo, raw)).max() <= 1
    mask = undistort(np.asarray(Image.open(capture / "masks" / name).resize((size, size))).astype(np.float32), raw)
    assert (view["mask"][..., 0].numpy() != (mask > 0.5)).mean() < 0.02
    camera = manager.train_dataset.cameras[3]
    assert camera.camera_type.item() == CameraType.PERSPECTIVE.value
    assert camera.distortion_params is not None
    assert not camera.distortion_params.any()
    values = torch.stack([camera.fx, camera.fy, camera.cx, camera.cy]).flatten().tolist()
    assert values == pytest.approx([target.fx, target.fy, target.cx, target.cy], rel=1e-5)
    assert manager.train_dataset.raw_cameras[3].camera_type.item() == CameraType.FISHEYE.value


@pytest.fixture(scope="module")
def finished(capture) -> Path:
    output = capture.parent / "out"
    main(["run", str(capture), "--output", str(output), "--steps", "30"])
    return output


def test_it_says_that_photos_are_undistorted_and_what_is_left_of_them(finished):
    (warning,) = [
        text
        for stage in json.loads((finished / "run.json").read_text()).values()
        for text in stage["done"]["warnings"]
        if "fisheye" in text
    ]
    target = undistorted_lens(LENS)
    left = distort(np.ones((target.height, target.width), np.float32), LENS, 0.0).mean()
    assert warning.startswith(f"fisheye photos are undistorted: training sees 120 degrees across, {left:.0%} of")
    assert warning in (finished / "report.html").read_text()


def test_the_artifact_comes_back_in_the_raw_frame(finished, tmp_path):
    config = finished / "training/ssa-splatfacto/config.yml"
    main(["export-overlay", "--load-config", str(config), "--raw-frame", "--output", str(tmp_path / "overlay")])
    rgba = np.asarray(Image.open(tmp_path / "overlay/overlay.png")).astype(float)
    assert rgba.shape == (SIZE, SIZE, 4)
    known = distort(np.ones((undistorted_lens(LENS).height,) * 2, np.float32), LENS, 0.0) > 0.999
    true = np.zeros((SIZE, SIZE), bool)
    true[PANEL] = True
    inner = np.zeros_like(true)
    inner[58:70, 24:60] = True
    assert rgba[inner & known, 3].mean() > 0.8 * 255
    assert rgba[~true & known, 3].mean() < 0.2 * 255
    assert np.abs(rgba[inner & known, :3].mean(axis=0) - COLOR).max() < 25
    rim = distort(np.ones((undistorted_lens(LENS).height,) * 2, np.float32), LENS, 0.0) == 0
    assert rim.mean() > 0.4
    assert not rgba[rim, 3].any(), "nothing was learned there"
