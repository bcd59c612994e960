"""Poses that are known before structure from motion; COLMAP's synthetic scenes are the oracle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from ssa_nerfstudio.sfm.known_poses import align, triangulate

VIEWS = 8


@pytest.fixture
def scene(tmp_path) -> tuple[Path, pycolmap.Reconstruction]:
    """A database of exact matches between eight photos that all see the same points, and its true model."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, VIEWS, 60
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        return tmp_path / "database.db", pycolmap.synthesize_dataset(options, database)


def poses_of(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {image.name: image.cam_from_world().matrix() for image in model.images.values() if image.has_pose}


def mapped(database: Path, poses: dict[str, np.ndarray]) -> tuple[set[str], Path]:
    folder = database.parent / "model"
    return triangulate(database, database.parent, poses, folder), folder


@pytest.mark.parametrize("wrong", [(), (0,), (7,), (2, 5), (1, 3, 6)])
def test_poses_that_the_matches_contradict_are_left_out(wrong, scene):
    """Each of them is another photo's: a pose that is right somewhere."""
    database, true = scene
    names = sorted(poses_of(true))
    poses = poses_of(true)
    poses |= {names[at]: poses_of(true)[names[(at + 4) % VIEWS]] for at in wrong}
    kept, folder = mapped(database, poses)
    assert kept == {*names} - {names[at] for at in wrong}
    found = pycolmap.Reconstruction(folder)
    assert poses_of(found).keys() == kept
    for name, pose in poses_of(found).items():
        np.testing.assert_allclose(pose, poses[name], atol=1e-6)
    assert found.num_points3D() == true.num_points3D()
    there, here = (np.array([point.xyz for point in each.points3D.values()]) for each in (true, found))
    nearest = np.linalg.norm(there[:, None] - here, axis=-1).min(axis=0)
    assert nearest.max() < 1e-4 * np.ptp(there, axis=0).max()


def test_photos_whose_poses_are_not_known_wait_for_the_mapping(scene):
    database, true = scene
    poses = dict(sorted(poses_of(true).items())[:5])
    kept, folder = mapped(database, poses)
    assert kept == poses.keys() == poses_of(pycolmap.Reconstruction(folder)).keys()


def test_where_most_poses_are_contradicted_none_is_taken(scene):
    database, true = scene
    names = sorted(poses_of(true))
    poses = {name: poses_of(true)[names[(3 * at + 5) % VIEWS]] for at, name in enumerate(names)}
    kept, folder = mapped(database, poses)
    assert kept == set()
    assert not folder.exists()


def model_of(poses: np.ndarray) -> pycolmap.Reconstruction:
    """A model of photos with these poses, camera from world [N, 3, 4], and one point."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=64, height=48, params=[60, 32, 24])
    model.add_camera_with_trivial_rig(camera)
    for number, pose in enumerate(poses, 1):
        image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    model.add_point3D(np.array([1.0, 2.0, 3.0]), pycolmap.Track(), np.zeros(3, np.uint8))
    return model


@pytest.mark.parametrize("on_a_line", [False, True], ids=["around", "on a line"])
@pytest.mark.parametrize("seed", range(4))
def test_a_model_that_was_moved_and_scaled_is_moved_back(seed, on_a_line):
    """Photos without an earlier pose, and points, move with the others."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(6, 3))
    if on_a_line:
        centers = centers[:1] + rng.normal(size=(6, 1)) * rng.normal(size=3)
    turns = Rotation.from_quat(rng.normal(size=(6, 4))).as_matrix()
    poses = np.concatenate([turns, -turns @ centers[..., None]], axis=-1)
    model = model_of(poses)
    turn = pycolmap.Rotation3d(Rotation.from_quat(rng.normal(size=4)).as_matrix())
    model.transform(pycolmap.Sim3d(rng.uniform(0.1, 9), turn, rng.normal(size=3)))
    align(model, {f"{number}.png": pose for number, pose in enumerate(poses[:5], 1)})
    for number, pose in enumerate(poses, 1):
        np.testing.assert_allclose(model.image(number).cam_from_world().matrix(), pose, atol=1e-9)
    (point,) = model.points3D.values()
    np.testing.assert_allclose(point.xyz, [1, 2, 3], atol=1e-9)
