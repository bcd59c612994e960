"""Camera groups: by frame size, by intrinsics where they are shared, and not by intrinsics that every photo has."""

from __future__ import annotations

import numpy as np

from ssa_nerfstudio.cameras.groups import group_frames

WIDE = (640, 480, 500.0, 500.0, 320.0, 240.0)
NARROW = (640, 480, 900.0, 900.0, 320.0, 240.0)
UPRIGHT = (480, 640, 500.0, 500.0, 240.0, 320.0)


def test_groups_are_numbered_in_order_of_first_appearance() -> None:
    assert group_frames(np.array([NARROW, WIDE, NARROW, WIDE])) == [0, 1, 0, 1]
    assert group_frames(np.array([UPRIGHT, WIDE, WIDE, UPRIGHT])) == [0, 1, 1, 0]


def test_intrinsics_within_the_tolerance_are_one_camera() -> None:
    frames = np.array([WIDE] * 4)
    frames[:, 2] += (0, 0.6, 0.7, 0.7)
    assert group_frames(frames) == [0, 0, 1, 1]  # the tolerance is 1e-3 of the width


def test_intrinsics_of_single_photos_are_ignored_and_sizes_are_not() -> None:
    frames = np.array([WIDE] * 5 + [UPRIGHT] * 2)
    frames[:, 2] += 10 * np.arange(7)
    assert group_frames(frames) == [0] * 5 + [1] * 2


def test_no_frames_form_no_group() -> None:
    assert group_frames(np.zeros((0, 6))) == []
