"""`ssa process --colmap`: models that exist already, good, spoiled by an artifact, and broken."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from small_captures import HEIGHT, WIDTH, poses, write

from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.sources import read_sources
from ssa_nerfstudio.sfm.existing_model import read_existing_model

VIEWS = 12
LENS = WIDTH / 2 / np.tan(np.radians(65 / 2))
_AXES = np.diag([1.0, -1, -1, 1])
WITHOUT_POSE, WRONG = (3, 8), 5


@pytest.fixture(scope="module")
def behind_dashboard(tmp_path_factory, draw_effect, photos) -> Path:
    """Photos behind a dashboard."""
    layers = draw_effect("dashboard", HEIGHT, WIDTH)
    return write(tmp_path_factory.mktemp("capture") / "photos", [layers.apply(photo) for photo in photos(VIEWS)])


def model_of(views: dict[int, np.ndarray], cameras: int = 1, name: str = "photo_{}.png") -> pycolmap.Reconstruction:
    """A model with the given camera-to-world matrices, and one point that all observe in the lower left corner."""
    model = pycolmap.Reconstruction()
    for number in range(1, cameras + 1):
        parameters = [LENS + number, WIDTH / 2, HEIGHT / 2]
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=parameters, camera_id=number
        )
        model.add_camera_with_trivial_rig(camera)
    track = pycolmap.Track()
    for place, (view, pose) in enumerate(views.items(), 1):
        spot = np.array([5.0, HEIGHT - 5.0])
        image = pycolmap.Image(
            name=name.format(view), camera_id=1 + view * cameras // VIEWS, image_id=place, keypoints=spot[None]
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(pose @ _AXES)[:3]))
        track.add_element(place, 0)
    model.add_point3D(np.zeros(3), track, np.zeros(3, np.uint8))
    return model


def repaired(capsys, photos: Path, model: Path, output: Path) -> tuple[str, dict[str, np.ndarray]]:
    """What the command says, and the pose of each photo, by its source, OpenGL axes in the model's world."""
    main(["process", "--threads", "1", "--train", str(photos), "--colmap", str(model), "--output", str(output)])
    meta = json.loads((output / "transforms.json").read_text())
    world = np.linalg.inv(np.vstack([meta["applied_transform"], [0, 0, 0, 1]]))
    found = {frame["source_name"]: world @ frame["transform_matrix"] for frame in meta["frames"]}
    return capsys.readouterr().out, found


@pytest.mark.slow
def test_a_model_is_repaired_in_its_own_world(tmp_path, capsys, behind_dashboard):
    """Two photos without a pose, one with another's; everything comes out at the true place, in the model's scale."""
    true = poses(VIEWS)
    true[:, :3, 3] *= 7
    views = {number: true[number] for number in range(VIEWS) if number not in WITHOUT_POSE}
    views[WRONG] = true[0]
    (tmp_path / "sparse/0").mkdir(parents=True)
    model_of(views).write_text(tmp_path / "sparse/0")
    said, found = repaired(capsys, behind_dashboard, tmp_path, tmp_path / "out")
    assert f"{VIEWS - 2} of {VIEWS} photos had a pose" in said
    assert "10 of 10 observations lay on the artifact, dropped" in said
    assert f"were dropped and tried again: 1 (photo_{WRONG}.png)" in said
    assert "photos without a pose have one now: 2 (photo_3.png, photo_8.png)" in said
    assert len(found) == VIEWS
    extent = np.linalg.norm(true[:, :3, 3] - true[:, :3, 3].mean(axis=0), axis=1).mean()
    for number in range(VIEWS):
        pose = found[f"photo_{number}.png"]
        assert np.linalg.norm(pose[:3, 3] - true[number, :3, 3]) < 0.05 * extent
        np.testing.assert_allclose(pose[:3, :3], true[number, :3, :3], atol=0.03)


@pytest.mark.slow
def test_poses_that_say_nothing_are_all_found_anew(tmp_path, capsys, behind_dashboard):
    true = poses(VIEWS)
    shuffled = {number: true[(5 * number + 3) % VIEWS] for number in range(VIEWS)}
    (tmp_path / "model").mkdir()
    model_of(shuffled).write_binary(tmp_path / "model")
    said, found = repaired(capsys, behind_dashboard, tmp_path / "model", tmp_path / "out")
    assert "most poses do not fit the photos off the artifact, all were found anew" in said
    assert len(found) == VIEWS


@pytest.mark.parametrize("cameras", [2, VIEWS], ids=["two", "one for each photo"])
def test_cameras_of_the_model(cameras, tmp_path, behind_dashboard):
    """Two cameras divide a folder's photos, those without a pose, too; one for each photo is one for all."""
    views = {number: pose for number, pose in enumerate(poses(VIEWS)) if number not in WITHOUT_POSE}
    model_of(views, cameras).write_binary(tmp_path)
    known = read_existing_model(tmp_path, behind_dashboard, read_sources(behind_dashboard, "frame", 3))
    assert [len(source.photos) for source in known.sources] == ([6, 6] if cameras == 2 else [VIEWS])
    assert [source.name for source in known.sources] == (
        ["colmap_camera_1", "colmap_camera_2"] if cameras == 2 else ["frame"]
    )
    for number, lens in enumerate(known.lenses):
        center = number + 1 if cameras == 2 else np.median([1 + view for view in views])
        np.testing.assert_allclose(lens, [LENS + center, LENS + center, WIDTH / 2, HEIGHT / 2, 0, 0, 0, 0])
    assert len(known.photos) == len(views)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda model: [file.unlink() for file in model.iterdir()], "holds no model of COLMAP"),
        (lambda model: (model / "cameras.bin").write_bytes(b"?" * 100), "cannot be read"),
        (lambda model: (model / "points3D.bin").write_bytes(b"?" * 3000), "cannot be read"),
        (lambda model: (model / "points3D.bin").write_bytes(np.random.default_rng(0).bytes(900)), "cannot be read"),
        (lambda model: (model / "images.bin").write_bytes((model / "images.bin").read_bytes()[:99]), "cannot be read"),
        (lambda model: model_of({0: np.eye(4)}, name="other/{}.jpg").write_binary(model), "0 of 1 photo with a pose"),
        (lambda model: model_of({n: np.full((4, 4), np.nan) for n in range(4)}).write_binary(model), "is not finite"),
        (lambda model: resized(model), "photo_0.png is 224 x 168, its camera in the model has 112 x 84"),
        (lambda model: fisheye(model), "the model has a THIN_PRISM_FISHEYE camera"),
    ],
)
def test_bad_models_end_in_one_line(damage, message, tmp_path, capsys, behind_dashboard):
    model = tmp_path / "model"
    model.mkdir()
    model_of(dict(enumerate(poses(VIEWS)))).write_binary(model)
    damage(model)
    with pytest.raises(SystemExit) as caught:
        main(["process", "--train", str(behind_dashboard), "--colmap", str(model), "--output", str(tmp_path / "out")])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def resized(folder: Path) -> None:
    model = model_of(dict(enumerate(poses(VIEWS))))
    model.cameras[1].width, model.cameras[1].height = WIDTH // 2, HEIGHT // 2
    model.write_binary(folder)


def fisheye(folder: Path) -> None:
    model = model_of(dict(enumerate(poses(VIEWS))))
    model.cameras[1].model = pycolmap.CameraModelId.THIN_PRISM_FISHEYE
    model.cameras[1].params = [LENS, LENS, WIDTH / 2, HEIGHT / 2] + [0.0] * 8
    model.write_binary(folder)
