"""Intrinsics and view matrices: where a point of the world is in a frame, whole or reduced."""

from __future__ import annotations

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from ssa_nerfstudio.plugin.view_geometry import frame, intrinsics, metadata, prepare, view_matrix


def cameras() -> Cameras:
    """Two cameras that look along -z; the second has a size, a lens and a place of its own."""
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    poses[1, :, 3] = torch.tensor([0.5, -1.0, 1.0])
    fx, fy, cx, cy = torch.tensor([[60.0, 50.0], [64.0, 40.0], [32.0, 21.0], [24.0, 15.0]])[..., None]
    return Cameras(poses, fx, fy, cx, cy, torch.tensor([[64], [40]]), torch.tensor([[48], [32]]))


@pytest.mark.parametrize("prepared", [False, True])
@pytest.mark.parametrize("reduction", [1, 2, 4])
def test_a_point_is_at_the_same_place_of_a_reduced_frame(reduction, prepared):
    """The point (1, 1, -4): from the origin (1, -1, 4) by OpenCV's axes, from (0.5, -1, 1) it is (0.5, -2, 5)."""
    singles = prepare(cameras(), (1, 2)) if prepared else [cameras()[k : k + 1] for k in range(2)]
    places = [(32 + 60 / 4, 24 - 64 / 4), (21 + 50 * 0.5 / 5, 15 - 40 * 2 / 5)]
    for camera, place in zip(singles, places, strict=True):
        K = intrinsics(camera, reduction)
        assert K.shape == (1, 3, 3)
        view = metadata(camera)["viewmat"] if prepared else view_matrix(camera.camera_to_worlds)
        x, y, z = (K[0] @ (view[0] @ torch.tensor([1.0, 1.0, -4.0, 1.0]))[:3]).tolist()
        assert (x / z, y / z) == pytest.approx((place[0] / reduction, place[1] / reduction))


def test_reduced_intrinsics_leave_the_camera_as_it_was():
    camera = cameras()[:1]
    intrinsics(camera, 4)
    torch.testing.assert_close(intrinsics(camera, 1)[0, :2, 2], torch.tensor([32.0, 24.0]))


def test_a_prepared_camera_knows_its_number_and_its_frame():
    singles = prepare(cameras(), (1,))
    assert [metadata(camera)["cam_idx"] for camera in singles] == [0, 1]
    assert (
        [frame(camera) for camera in singles] == [frame(cameras()[k : k + 1]) for k in range(2)] == [(64, 48), (40, 32)]
    )
