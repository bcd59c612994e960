"""What structure from motion estimated is checked before anything is trained on it."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.sfm.registration import (
    PassRegistration,
    check_lenses,
    check_registrations,
    warn_of_equal_cameras,
)


def model(*lenses: list[float]) -> pycolmap.Reconstruction:
    """One registered photo of 960 x 540 pixels for each lens: focal lengths, unless usual, k1, k2, p1, p2."""
    found = pycolmap.Reconstruction()
    for number, distortion in enumerate(lenses, 1):
        params = [*(distortion[:-4] or [700, 700]), 480, 270, *distortion[-4:]]
        camera = pycolmap.Camera(camera_id=number, model="OPENCV", width=960, height=540, params=params)
        found.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{number}.png", camera_id=number, image_id=number)
        found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.eye(3, 4)))
    return found


def test_a_lens_that_no_camera_has_is_refused_by_its_name():
    """Its values are those of a drive straight ahead, of which half of the photos registered."""
    check_lenses(["front", "side"], model([-0.2, 0.05, 0, 0], [0.1, 0, 0.001, 0]))
    with pytest.raises(InputError, match=r"for the photos of side is none \(k1 = 2, k2 = -0.21\)"):
        check_lenses(["front", "side"], model([-0.2, 0.05, 0, 0], [6231.8, 247.9, 2.0042, -0.2101, -0.5735, 0.4871]))


def test_pixels_that_no_camera_has_are_warned_of_by_its_name(caplog):
    check_lenses(["front", "side"], model([-0.2, 0.05, 0, 0], [800, 700, 0.1, 0, 0, 0]))
    assert not caplog.records
    check_lenses(["front", "side"], model([-0.2, 0.05, 0, 0], [1000, 700, 0.1, 0, 0, 0]))
    assert "for the photos of side would have pixels of 1.4:1 (focal lengths 1000 and 700)" in caplog.text
    caplog.clear()
    check_lenses(["front", "side"], model([500, 700, 0.1, 0, 0, 0], [-0.2, 0.05, 0, 0]))
    assert "for the photos of front would have pixels of 1.4:1" in caplog.text


def test_cameras_that_training_takes_for_one_are_named(caplog):
    lenses = [[700, 700, 0, 0, 0, 0], [500, 500, 0, 0, 0, 0], [700.1, 700.1, 0.01, 0, 0, 0], [500, 500, 0, 0, 0, 0]]
    warn_of_equal_cameras(model(*lenses), ["front", "side", "back"])  # the fourth has photos for tests
    (record,) = caplog.records
    assert "the cameras front and back have nearly the same intrinsics" in record.message


@pytest.mark.parametrize(
    ("masked_by", "remedy"),
    [
        (None, "mask what covers part of every frame, or take"),
        ("user", r"black on the artifact \(else --invert-mask\), or take"),
        ("detection", "required; take"),
    ],
)
def test_the_remedy_of_few_poses_depends_on_whose_mask_it_is(masked_by, remedy):
    few = [PassRegistration("front", 4, ("2.png", "3.png", "4.png"))]
    check_registrations(few, 0.25, masked_by)
    with pytest.raises(InputError, match=f"only 1 of 4 photos .*{remedy}"):
        check_registrations(few, 0.5, masked_by)
