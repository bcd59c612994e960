"""The image circle of fisheye photos is found, whole or cut off by the frame, and only where there is one."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from small_captures import poses
from wide_captures import fisheye, panorama_poses

from ssa_nerfstudio.cameras.image_circle import Circle, brightest, image_circle


@pytest.mark.parametrize(("size", "focal", "widest"), [(128, 40.0, 85), (128, 44.0, 90), (96, 20.0, 92)])
def test_it_is_that_of_the_lens(trace_built_in_scene, size, focal, widest):
    photos = [fisheye(trace_built_in_scene, pose, size, focal, widest=widest) for pose in panorama_poses(3)]
    circle = image_circle(brightest(photos))
    assert circle is not None
    assert circle == pytest.approx((size / 2, size / 2, focal * np.radians(widest)), abs=1)


def test_noise_and_a_flare_outside_do_not_move_it():
    inside = Circle(70, 50, 45).coverage(100, 140)
    photos = inside[None, ..., None] * np.random.default_rng(0).integers(40, 255, (4, 100, 140, 3))
    photos += np.random.default_rng(1).integers(0, 12, photos.shape)
    photos[:, 20:30, 8:14] = 200
    circle = image_circle(brightest(photos.astype(np.uint8)))
    assert circle == pytest.approx((70, 50, 45), abs=1)


def test_other_photos_have_none(photos, captures):
    assert image_circle(brightest(photos(len(poses(3))))) is None
    real = [np.asarray(Image.open(path)) for path in sorted((captures / "gopro_walk/images").glob("*"))[:3]]
    assert image_circle(brightest(real)) is None
    assert image_circle(np.zeros((60, 80), np.uint8)) is None
    letterboxed = np.zeros((60, 80), np.uint8)
    letterboxed[10:-10] = 90
    assert image_circle(letterboxed) is None
    inset = np.zeros((60, 80), np.uint8)
    inset[10:-10, 10:-10] = 90
    assert image_circle(inset) is None


def test_coverage_is_the_circles_area():
    coverage = Circle(30.3, 20.8, 15).coverage(40, 60)
    assert coverage.sum() == pytest.approx(np.pi * 15**2, rel=0.01)
    assert coverage[20, 30] == 1
    assert coverage[0, 0] == 0
