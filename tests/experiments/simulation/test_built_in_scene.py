"""The ray-cast capture: geometry, colors and the files that nerfstudio reads."""

from __future__ import annotations

import ctypes
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.dashboard import Dashboard
from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene


@pytest.fixture(scope="module")
def scene() -> DemoScene:
    return DemoScene(views=12, test_views=3, width=80, height=56)


@pytest.fixture(scope="module")
def artifact(scene: DemoScene) -> Layers:
    return Dashboard().layers(scene.height, scene.width, np.random.default_rng(0))


@pytest.fixture(scope="module")
def dataset(scene: DemoScene, artifact: Layers, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "made" / "room"
    scene.write(folder, artifact)
    return folder


def pixel_grid(scene: DemoScene, step: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(step / 2, scene.width, step), np.arange(step / 2, scene.height, step))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def project(scene: DemoScene, camera_to_world: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel positions [N, 2] and depths [N] from the matrix alone, independently of `DemoScene.rays`."""
    x, y, z = np.linalg.inv(camera_to_world)[:3] @ np.vstack([points.T, np.ones(len(points))])
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.stack(
            [scene.width / 2 + scene.focal_length * x / -z, scene.height / 2 - scene.focal_length * y / -z]
        )
    return pixels.T, -z


def in_frame(scene: DemoScene, pixels: np.ndarray, depth: np.ndarray, margin: float = 0.0) -> np.ndarray:
    inside = (pixels > margin) & (pixels < np.array([scene.width, scene.height]) - margin)
    return inside.all(axis=1) & (depth > 0)


def visible(scene: DemoScene, camera_to_world: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which points nothing hides from the camera [N], and the colors seen in their directions [N, 3]."""
    reached, colors = scene.trace(camera_to_world[:3, 3], points - camera_to_world[:3, 3])
    return reached > 0.999, colors


def test_a_surface_point_has_one_color_in_all_views(scene: DemoScene) -> None:
    train, _ = scene.cameras
    pixels = pixel_grid(scene, 4)
    compared = 0
    for first, second in ((0, 1), (3, 7), (11, 5)):
        directions = scene.rays(train[first], pixels)
        depth, colors = scene.trace(train[first][:3, 3], directions)
        points = train[first][:3, 3] + depth[:, None] * directions
        seen, seen_colors = visible(scene, train[second], points)
        difference = np.abs(seen_colors - colors)[seen].max(axis=1)
        # A point on the border of two texels may fall to either side.
        assert (difference < 1e-6).mean() > 0.99
        compared += int(seen.sum())
    assert compared > 300


def test_a_photo_pixel_is_the_mean_of_its_rays(scene: DemoScene) -> None:
    pose = scene.cameras[0][4]
    photo = scene.render(pose)
    offsets = (np.arange(3) + 0.5) / 3
    for row, column in ((0, 0), (20, 71), (55, 79)):
        x, y = np.meshgrid(column + offsets, row + offsets)
        _, colors = scene.trace(pose[:3, 3], scene.rays(pose, np.stack([x, y], axis=-1).reshape(-1, 2)))
        assert photo[row, column] == pytest.approx(255 * colors.mean(axis=0), abs=0.51)


def test_rays_and_projection_are_inverse(scene: DemoScene) -> None:
    pose, pixels = scene.cameras[1][0], pixel_grid(scene, 4)
    found, depth = project(scene, pose, pose[:3, 3] + 2.5 * scene.rays(pose, pixels))
    assert found == pytest.approx(pixels, abs=1e-6)
    assert depth == pytest.approx(np.full(len(pixels), 2.5))


def test_cameras_are_upright_rigid_and_inside_the_room(scene: DemoScene) -> None:
    train, test = scene.cameras
    assert (len(train), len(test)) == (12, 3)
    for pose in np.concatenate([train, test]):
        rotation = pose[:3, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert rotation[2, 0] == pytest.approx(0, abs=1e-12)
        assert rotation[2, 1] > 0
        assert np.abs(pose[:2, 3]).max() < 4.4
        assert 0 < pose[2, 3] < 3.6


def test_every_ray_meets_a_surface(scene: DemoScene) -> None:
    for pose in np.concatenate(scene.cameras):
        depth, colors = scene.trace(pose[:3, 3], scene.rays(pose, pixel_grid(scene, 1)))
        assert np.isfinite(depth).all()
        assert (colors > 0).any(axis=1).all()


def test_test_cameras_lie_between_training_cameras(scene: DemoScene) -> None:
    def azimuths(poses: np.ndarray) -> np.ndarray:
        return np.arctan2(poses[:, 1, 3], poses[:, 0, 3])

    train, test = map(azimuths, scene.cameras)
    for azimuth in test:
        assert train.min() < azimuth < train.max()
        assert np.abs(train - azimuth).min() > 1e-3


def test_what_a_dashboard_hides_is_seen_in_other_views() -> None:
    scene = DemoScene()
    train, test = scene.cameras
    pixels = pixel_grid(scene, 8)
    pixels = pixels[pixels[:, 1] > 0.7 * scene.height]
    counts = []
    for pose in test[::2]:
        directions = scene.rays(pose, pixels)
        depth, _ = scene.trace(pose[:3, 3], directions)
        points = pose[:3, 3] + depth[:, None] * directions
        views = np.zeros(len(points), dtype=int)
        for other in train:
            position, other_depth = project(scene, other, points)
            above = in_frame(scene, position, other_depth) & (position[:, 1] < 0.7 * scene.height)
            views += above & visible(scene, other, points)[0]
        counts.append(views)
    assert (np.concatenate(counts) >= 3).mean() > 0.95


def test_scene_follows_its_seed() -> None:
    small = {"views": 3, "test_views": 1, "width": 24, "height": 16}
    first, again, other = DemoScene(**small), DemoScene(**small), DemoScene(**small, seed=1)
    pose = first.cameras[0][1]
    assert np.array_equal(pose, again.cameras[0][1])
    assert np.array_equal(first.render(pose), again.render(pose))
    assert all(np.array_equal(*pair) for pair in zip(first.sparse_points(), again.sparse_points(), strict=True))
    assert not np.array_equal(pose, other.cameras[0][1])
    assert not np.array_equal(first.render(pose), other.render(pose))


def test_transforms_json(scene: DemoScene, dataset: Path) -> None:
    transforms = json.loads((dataset / "transforms.json").read_text())
    assert transforms["camera_model"] == "OPENCV"
    assert (transforms["w"], transforms["h"], transforms["cx"], transforms["cy"]) == (80, 56, 40.0, 28.0)
    assert transforms["fl_x"] == transforms["fl_y"] == pytest.approx(40 / np.tan(np.radians(32.5)))
    assert transforms["ply_file_path"] == "sparse_pc.ply"
    assert not {"k1", "k2", "p1", "p2", "applied_transform"} & transforms.keys()

    assert transforms["train_filenames"] == [f"images/train_{number:04d}.png" for number in range(12)]
    assert transforms["test_filenames"] == [f"images/test_{number:04d}.png" for number in range(3)]
    assert transforms["val_filenames"] == transforms["test_filenames"]
    poses = {frame["file_path"]: np.array(frame["transform_matrix"]) for frame in transforms["frames"]}
    assert sorted(poses) == sorted(f"images/{path.name}" for path in (dataset / "images").iterdir())
    train, test = scene.cameras
    assert np.array_equal(poses["images/train_0007.png"], train[7])
    assert np.array_equal(poses["images/test_0002.png"], test[2])


def test_the_artifact_is_on_training_images_only(scene: DemoScene, artifact: Layers, dataset: Path) -> None:
    for split, poses in zip(("train", "test"), scene.cameras, strict=True):
        for number, pose in enumerate(poses):
            photo = scene.render(pose)
            written = np.asarray(Image.open(dataset / f"images/{split}_{number:04d}.png"))
            assert np.array_equal(written, artifact.apply(photo) if split == "train" else photo)


def test_open3d_reads_the_sparse_points(scene: DemoScene, dataset: Path) -> None:
    if sys.platform == "linux":
        # open3d, nerfstudio's reader, links to libusb, which slim systems have only through this wheel.
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    cloud = open3d.io.read_point_cloud(dataset / "sparse_pc.ply")
    points, colors = scene.sparse_points()
    assert np.asarray(cloud.points) == pytest.approx(points, abs=1e-5)
    assert np.asarray(cloud.colors) * 255 == pytest.approx(colors.astype(float), abs=0.01)


def test_sparse_points_have_the_colors_of_the_photos(scene: DemoScene) -> None:
    points, colors = scene.sparse_points()
    assert points.shape == colors.shape == (4000, 3)
    colors = colors / 255
    differences, shuffled = [], []
    for pose in scene.cameras[1]:
        position, depth = project(scene, pose, points)
        # Points are off their surface by the noise, so what hides them is further off than that.
        reached, _ = scene.trace(pose[:3, 3], points - pose[:3, 3])
        seen = in_frame(scene, position, depth) & (reached > 0.97)
        column, row = position[seen].astype(int).T
        photo = scene.render(pose)[row, column] / 255
        differences.append(np.abs(photo - colors[seen]).mean(axis=1))
        shuffled.append(np.abs(photo - np.roll(colors[seen], 1, axis=0)).mean(axis=1))
    difference = np.concatenate(differences)
    assert len(difference) > 1000
    assert np.median(difference) < 0.05
    assert difference.mean() < 0.5 * np.concatenate(shuffled).mean()


def test_nothing_is_left_of_an_interrupted_run(
    scene: DemoScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: DemoScene) -> None:
        assert not (tmp_path / "room").exists()
        raise KeyboardInterrupt

    monkeypatch.setattr(DemoScene, "sparse_points", interrupt)
    with pytest.raises(KeyboardInterrupt):
        scene.write(tmp_path / "room", None)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_kept(scene: DemoScene, dataset: Path) -> None:
    before = (dataset / "transforms.json").stat().st_mtime_ns
    with pytest.raises(InputError, match="exists already"):
        scene.write(dataset, None)
    assert (dataset / "transforms.json").stat().st_mtime_ns == before


def test_an_artifact_of_another_size_is_refused(scene: DemoScene, tmp_path: Path) -> None:
    artifact = Dashboard().layers(56, 81, np.random.default_rng(0))
    with pytest.raises(ValueError, match="artifact is 81 x 56, the scene's images are 80 x 56"):
        scene.write(tmp_path / "room", artifact)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("field", "value"),
    [("views", 1), ("test_views", 0), ("test_views", 49), ("width", 0), ("height", 0), ("fov_x", 180.0), ("seed", -1)],
)
def test_bad_fields_are_named(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"DemoScene\.{field} must be .*got {value}"):
        DemoScene(**{field: value})  # pyright: ignore[reportArgumentType]
