"""`ssa process --projection fisheye` on photos of 180 degrees whose cameras are known."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_captures import write
from wide_captures import fisheye, panorama_poses

from benchmarks.sfm_accuracy import center_errors
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.sfm.fisheye_guess import fisheye_guess

VIEWS, SIZE, K1 = 10, 256, -0.03
FOCAL = SIZE / 2 / (np.pi / 2 * (1 + K1 * (np.pi / 2) ** 2))


@pytest.fixture(scope="module")
def capture(tmp_path_factory, trace_built_in_scene):
    poses = panorama_poses(2 * VIEWS)[:VIEWS]
    photos = [fisheye(trace_built_in_scene, pose, SIZE, FOCAL, K1) for pose in poses]
    return write(tmp_path_factory.mktemp("capture") / "photos", photos), poses


def test_lens_and_poses_are_found(capture, tmp_path):
    photos, poses = capture
    output = tmp_path / "dataset"
    main(["process", "--train", str(photos), "--output", str(output), "--projection", "fisheye", "--threads", "1"])
    meta = json.loads((output / "transforms.json").read_text())
    assert meta["camera_model"] == "OPENCV_FISHEYE"
    found = {frame["file_path"]: np.array(frame["transform_matrix"]) for frame in meta["frames"]}
    centers = np.array([found[f"images/frame_{number + 1:05d}.png"][:3, 3] for number in range(VIEWS)])
    extent = np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0), axis=1).mean()
    assert center_errors(centers, poses[:, :3, 3]).max() < 0.02 * extent
    # The lens as a whole: coefficients make up for each other.
    theta = np.linspace(0.1, 1.4, 20)
    radius = meta["fl_x"] * (theta + sum(meta[f"k{n}"] * theta ** (2 * n + 1) for n in (1, 2, 3, 4)))
    np.testing.assert_allclose(radius, FOCAL * (theta + K1 * theta**3), atol=1.5)
    assert {view.lens.model for view in Dataset.read(output, 8).views} == {"fisheye"}


def test_the_estimate_starts_from_the_image_circle_or_from_130_degrees(capture, photos, tmp_path):
    f, _, cx, cy, *ks = fisheye_guess(sorted(capture[0].iterdir()))
    assert (f, cx, cy) == pytest.approx((SIZE / np.pi, SIZE / 2, SIZE / 2), abs=1)
    assert ks == [0.0] * 4
    full = write(tmp_path / "full", photos(3))
    assert fisheye_guess(sorted(full.iterdir()))[0] == pytest.approx(224 / np.radians(130))
