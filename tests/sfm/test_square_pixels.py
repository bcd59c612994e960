"""Focal lengths of both axes are equal unless the photos tell otherwise."""

from __future__ import annotations

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from ssa_nerfstudio.sfm.square_pixels import are_held, free, hold, refined, with_opencv_lenses

VIEWS, FOCAL = 12, 400.0


def walk(tilt: float, stretch: float) -> pycolmap.Reconstruction:
    """Photos of a walk that turns about the vertical, and by some degrees about the other axes.

    Args:
        tilt: of the latter, degrees.
        stretch: vertical focal length of the photos, in horizontal ones; the model has a lens with square pixels.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform([-6, -1.5, 2], [6, 1.5, 7], (400, 3))
    camera = pycolmap.Camera(camera_id=1, model="RADIAL", width=640, height=480, params=[FOCAL, 320, 240, 0, 0])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    seen: dict[int, list[tuple[int, int]]] = {}
    for number in range(VIEWS):
        angles = [3 * number - 15, *(tilt * rng.uniform(-1, 1, 2))]
        turn = Rotation.from_euler("YXZ", angles, degrees=True).as_matrix().T
        pose = np.column_stack([turn, -turn @ [0.4 * number - 2, 0.2 * np.sin(number), 0.1 * number]])
        there = points @ turn.T + pose[:, 3]
        pixels = there[:, :2] / there[:, 2:] * FOCAL * [1, stretch] + [320, 240]
        pixels += rng.normal(scale=0.3, size=pixels.shape)
        inside = np.flatnonzero((there[:, 2] > 1) & ((pixels > 0) & (pixels < [640, 480])).all(axis=1))
        image = pycolmap.Image(name=f"{number}.png", keypoints=pixels[inside], camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for feature, point in enumerate(inside):
            seen.setdefault(int(point), []).append((number + 1, feature))
    for point, features in seen.items():
        track = pycolmap.Track()
        for number, feature in features:
            track.add_element(number, feature)
        if len(features) > 2:
            model.add_point3D(points[point], track, np.zeros(3, np.uint8))
    return model


@pytest.mark.parametrize(
    ("tilt", "stretch", "aspect"), [(0, 1, 1), (10, 1, 1), (10, 1.15, 1.15)], ids=["level", "tilted", "stretched"]
)
def test_focal_lengths_are_equal_unless_the_photos_fit_much_better_otherwise(tilt, stretch, aspect):
    model = walk(tilt, stretch)
    assert are_held(model)
    found = refined(with_opencv_lenses(model), 1)
    assert are_held(model)
    assert found.cameras[1].model.name == "OPENCV"
    fx, fy = found.cameras[1].params[:2]
    assert fx == pytest.approx(FOCAL, rel=0.02)
    assert fy / fx == pytest.approx(aspect, abs=0.02 if stretch > 1 else 1e-9)


def test_a_lens_keeps_its_distortion():
    model = walk(0, 1)
    model.cameras[1].params = [500, 320, 240, -0.2, 0.05]
    np.testing.assert_array_equal(with_opencv_lenses(model).cameras[1].params, [500, 500, 320, 240, -0.2, 0.05, 0, 0])


def test_one_focal_length_is_for_the_mapping_only(tmp_path):
    """What EXIF data say of the lens stays."""
    cameras = [pycolmap.Camera.create_from_model_name(n, "OPENCV", 300.0 * n, 640, 480) for n in (1, 2)]
    cameras[1].has_prior_focal_length = True
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        for camera in cameras:
            database.write_camera(camera, use_camera_id=True)
    for change, name, axes in ((hold, "RADIAL", 1), (free, "OPENCV", 2)):
        change(tmp_path / "database.db")
        with pycolmap.Database.open(tmp_path / "database.db") as database:
            for camera in database.read_all_cameras():
                assert camera.model.name == name
                np.testing.assert_array_equal(camera.params[:axes], 300.0 * camera.camera_id)
                assert camera.has_prior_focal_length == (camera.camera_id == 2)
