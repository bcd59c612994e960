"""`ssa export-dataset`: every program finds the photos, their masks with the right polarity, the poses and the points.

nerfstudio and COLMAP read with their own code. Others are held against the layout that they document, restated here.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from small_captures import HEIGHT, WIDTH, poses
from small_checkpoints import cameras, write_run

from ssa_nerfstudio.cameras.lens import Lens, distort, undistort, undistorted_lens
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.capture_artifact import DetectedArtifact
from ssa_nerfstudio.export.trainer_presets import PRESETS
from ssa_nerfstudio.overlay.layer import OracleOverlay

VIEWS = 4
LENSES = {
    "front": Lens(WIDTH, HEIGHT, 190, 190, 112, 84, (-0.1, 0, 0, 0, 0, 0)),
    "side": Lens(WIDTH, HEIGHT, 150, 150, 112, 84, (-0.05, 0, 0, 0, 0, 0)),
}
"""Two cameras of a rig, in a folder each."""
BOXES = {"front": (slice(100, 140), slice(30, 120)), "side": (slice(20, 60), slice(90, 200))}
"""Where each has a panel, in the undistorted frame."""
MASKS: dict[str, Callable[[str, str], str]] = {
    "nerfstudio": lambda folder, stem: f"masks/{folder}/{stem}.png",
    "colmap": lambda folder, stem: f"masks/{folder}/{stem}.png.png",
    "lichtfeld": lambda folder, stem: f"masks/{folder}/{stem}.png",
    "brush": lambda folder, stem: f"masks/{folder}/{stem}.png",
    "3dgrut": lambda folder, stem: f"images/{folder}/{stem}_mask.png",
}
"""Names of masks of PNG photos as the programs look for them: see `trainer_presets` for the sources."""


def layers(camera: str, hidden: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """T and B of a camera's gray panel [H, W, 3] in the undistorted frame."""
    target = undistorted_lens(LENSES[camera])
    transmittance = np.ones((target.height, target.width, 3), np.float32)
    transmittance[BOXES[camera]] = 1 - hidden
    return transmittance, 0.3 * (1 - transmittance)


def checkpoint(folder: Path, hidden: float = 1.0) -> Path:
    overlays = [OracleOverlay(*map(torch.from_numpy, layers(camera, hidden))) for camera in LENSES]
    return write_run(folder, cameras(list(zip(overlays, LENSES.values(), strict=True))))


def true_mask(camera: str, frame: str) -> np.ndarray:
    """Pixels that show the scene, bool [H, W]."""
    scene = layers(camera)[0][..., 0]
    return (distort(scene, LENSES[camera], 1.0) if frame == "raw" else scene) > 0.5


@pytest.fixture(scope="module")
def rig(tmp_path_factory, photos) -> Path:
    """A dataset of two cameras whose photos carry a panel each."""
    folder = tmp_path_factory.mktemp("rig")
    frames = []
    pictures, cameras_to_world = photos(2 * VIEWS), poses(2 * VIEWS)
    for number in range(2 * VIEWS):
        camera = list(LENSES)[number % 2]
        lens = LENSES[camera]
        transmittance, addition = (
            distort(layer, lens, fill) for layer, fill in zip(layers(camera), (1, 0), strict=True)
        )
        photo = np.rint(255 * (pictures[number] / 255 * transmittance + addition)).clip(0, 255).astype(np.uint8)
        name = f"images/{camera}/view_{number // 2}.png"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo).save(folder / name)
        intrinsics = {"w": lens.width, "h": lens.height, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
        frames.append(
            {"file_path": name, "transform_matrix": cameras_to_world[number].tolist(), **intrinsics}
            | {"k1": lens.distortion[0], "k2": 0, "p1": 0, "p2": 0}
        )
    applied = [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0.5]]
    points = ["0 0 0 10 20 30", "1 2 3 200 100 50"]
    header = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {a}" for a in "xyz")]
    header += [*(f"property uchar {c}" for c in ("red", "green", "blue")), "end_header"]
    (folder / "sparse_pc.ply").write_text("\n".join([*header, *points]) + "\n")
    meta = {"camera_model": "OPENCV", "applied_transform": applied, "ply_file_path": "sparse_pc.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def export(rig: Path, output: Path, program: str, *options: object, hidden: float = 1.0) -> Path:
    config = checkpoint(output.parent / f"run-{hidden}", hidden)
    main(["export-dataset", "--for", program, "--load-config", str(config), "--data", str(rig), "--output", str(output),
          *map(str, options)])  # fmt: skip
    return output


def opened(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def agree(mask: np.ndarray, true: np.ndarray) -> bool:
    """Equal but for pixels at the edge."""
    return mask.shape == true.shape and float((mask != true).mean()) < 0.005


def test_nerfstudio_reads_photos_poses_points_and_masks(rig, tmp_path):
    folder = export(rig, tmp_path / "out", "nerfstudio")
    parsed, original = (
        NerfstudioDataParserConfig(data=data, eval_mode="all", load_3D_points=True)
        .setup()
        .get_dataparser_outputs("train")
        for data in (folder, rig)
    )
    assert torch.equal(parsed.cameras.camera_to_worlds, original.cameras.camera_to_worlds)
    assert torch.equal(parsed.cameras.distortion_params, original.cameras.distortion_params)
    assert torch.equal(parsed.metadata["points3D_xyz"], original.metadata["points3D_xyz"])
    dataset = InputDataset(parsed)
    for number, path in enumerate(parsed.image_filenames):
        camera = path.parent.name
        assert path.read_bytes() == (rig / path.relative_to(folder)).read_bytes()
        assert agree(dataset.get_data(number)["mask"][..., 0].numpy(), true_mask(camera, "raw"))


def test_colmap_finds_no_feature_where_its_masks_are_black(rig, tmp_path):
    folder = export(rig, tmp_path / "out", "colmap")
    reader = pycolmap.ImageReaderOptions()
    reader.mask_path = str(folder / "masks")
    database = tmp_path / "database.db"
    pycolmap.extract_features(database, folder / "images", reader_options=reader)
    with pycolmap.Database.open(database) as found:
        images = found.read_all_images()
        assert len(images) == 2 * VIEWS
        for image in images:
            keypoints = found.read_keypoints(image.image_id)[:, :2]
            x, y = np.floor(keypoints).astype(int).T
            black = cv2.erode((~true_mask(Path(image.name).parent.name, "raw")).astype(np.uint8), np.ones((3, 3)))
            assert len(keypoints) > 20
            assert not black[y, x].any()


@pytest.mark.parametrize("program", sorted(set(PRESETS) - {"nerfstudio"}))
def test_the_model_holds_the_cameras_of_the_dataset(rig, tmp_path, program):
    folder = export(rig, tmp_path / "out", program)
    model = pycolmap.Reconstruction(folder / "sparse/0")
    meta = json.loads((rig / "transforms.json").read_text())
    applied = np.vstack([meta["applied_transform"], [0, 0, 0, 1]])
    true = {frame["file_path"].removeprefix("images/"): np.array(frame["transform_matrix"]) for frame in meta["frames"]}
    assert {image.name for image in model.images.values()} == set(true)
    distorted = PRESETS[program].frame == "raw"
    for image in model.images.values():
        pose = np.linalg.inv(applied) @ true[image.name]
        np.testing.assert_allclose(image.projection_center(), pose[:3, 3], atol=1e-9)
        # OpenGL's camera looks along -z, COLMAP's along z.
        np.testing.assert_allclose(image.viewing_direction(), -pose[:3, 2], atol=1e-9)
        lens = LENSES[Path(image.name).parent.name]
        camera = model.cameras[image.camera_id]
        target = lens if distorted else undistorted_lens(lens)
        assert camera.model.name == ("OPENCV" if distorted else "PINHOLE")
        np.testing.assert_allclose(camera.params[:4], [target.fx, target.fy, target.cx, target.cy])
        assert opened(folder / "images" / image.name).shape[:2] == (camera.height, camera.width)
    found = {tuple(point.color): applied[:3, :3] @ point.xyz + applied[:3, 3] for point in model.points3D.values()}
    np.testing.assert_allclose(found[10, 20, 30], [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(found[200, 100, 50], [1, 2, 3], atol=1e-6)


def test_points_that_are_not_finite_are_left_out_of_the_model_as_of_a_training(rig, tmp_path, caplog):
    broken = Path(shutil.copytree(rig, tmp_path / "rig"))
    points = (broken / "sparse_pc.ply").read_text().replace("vertex 2", "vertex 4")
    (broken / "sparse_pc.ply").write_text(points + "nan 1 2 1 2 3\n3 inf 1 4 5 6\n")
    folder = export(broken, tmp_path / "out", "colmap")
    model = pycolmap.Reconstruction(folder / "sparse/0")
    assert sorted(tuple(point.color) for point in model.points3D.values()) == [(10, 20, 30), (200, 100, 50)]
    assert all(np.isfinite(point.xyz).all() for point in model.points3D.values())
    assert "2 of the dataset's 4 3D points are not finite" in caplog.text


@pytest.mark.parametrize("program", sorted(MASKS))
def test_masks_have_the_names_that_the_program_looks_for(rig, tmp_path, program):
    folder = export(rig, tmp_path / "out", program)
    expected = {MASKS[program](camera, f"view_{n}"): camera for camera in LENSES for n in range(VIEWS)}
    for name, camera in expected.items():
        mask = opened(folder / name)
        assert mask.dtype == np.uint8
        assert set(np.unique(mask)) == {0, 255}
        assert agree(mask > 0, true_mask(camera, PRESETS[program].frame))
    pngs = {str(path.relative_to(folder)) for path in folder.rglob("*.png")}
    photos = {f"images/{camera}/view_{n}.png" for camera in LENSES for n in range(VIEWS)}
    assert pngs == photos | set(expected)


def test_postshot_has_the_mask_in_the_alpha_channel(rig, tmp_path):
    folder = export(rig, tmp_path / "out", "postshot")
    for camera, lens in LENSES.items():
        rgba = opened(folder / f"images/{camera}/view_1.png")
        assert agree(rgba[..., 3] == 255, true_mask(camera, "undistorted"))
        photo = opened(rig / f"images/{camera}/view_1.png")
        assert np.array_equal(rgba[..., :3], undistort(photo, lens))
    assert not (folder / "masks").exists()


def test_cleaned_photos_show_the_scene_and_holes_are_masked(rig, tmp_path, photos):
    """A panel that lets most of the light through leaves no hole; an opaque one leaves itself."""
    opaque = export(rig, tmp_path / "opaque", "brush", "--photos", "cleaned")
    mask = opened(opaque / "masks/front/view_0.png") > 0
    assert agree(mask, true_mask("front", "undistorted"))
    assert opened(opaque / "images/front/view_0.png")[~mask].max() == 0

    veiled = tmp_path / "veiled"
    meta = json.loads((rig / "transforms.json").read_text())
    for number, frame in enumerate(meta["frames"]):
        camera = Path(frame["file_path"]).parent.name
        lens = LENSES[camera]
        transmittance, addition = (
            distort(layer, lens, fill) for layer, fill in zip(layers(camera, 0.4), (1, 0), strict=True)
        )
        photo = np.rint(255 * (photos(2 * VIEWS)[number] / 255 * transmittance + addition)).clip(0, 255)
        (veiled / frame["file_path"]).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo.astype(np.uint8)).save(veiled / frame["file_path"])
    (veiled / "transforms.json").write_text(json.dumps(meta))
    (veiled / "sparse_pc.ply").write_bytes((rig / "sparse_pc.ply").read_bytes())
    clean = export(veiled, tmp_path / "clean", "nerfstudio", "--photos", "cleaned", hidden=0.4)
    photo = opened(clean / "images/front/view_0.png").astype(float)
    inside = ~true_mask("front", "raw")
    inside = cv2.erode(inside.astype(np.uint8), np.ones((9, 9))) > 0
    assert np.abs(photo - photos(2 * VIEWS)[0])[inside].mean() < 2
    assert (opened(clean / "masks/front/view_0.png") == 255).all()
    assert "100.0%" in (clean / "README.md").read_text()


def test_the_page_in_the_folder_has_the_command_and_what_is_left(rig, tmp_path, capsys):
    folder = export(rig, tmp_path / "out", "lichtfeld")
    page = (folder / "README.md").read_text()
    assert "    LichtFeld-Studio -d . -o output --mask-mode ignore\n" in page
    shares = {camera: f"{true_mask(camera, 'undistorted').mean():.1%}" for camera in LENSES}
    for camera in LENSES:
        assert f"| {camera}/view_2.png | {shares[camera]} |" in page
    least = min(shares.values(), key=lambda share: float(share[:-1]))
    assert f"of the one with the largest mask {least}" in page
    assert f"of the one with the largest mask {least}" in capsys.readouterr().out
    assert str(tmp_path) not in page


def test_a_mask_of_the_dataset_is_kept_and_clean_test_photos_are_not_masked(rig, tmp_path):
    data = tmp_path / "data"
    meta = json.loads((rig / "transforms.json").read_text())
    given = np.full((HEIGHT, WIDTH), 255, np.uint8)
    given[:30] = 0
    for frame in meta["frames"]:
        for folder in ("images", "masks"):
            (data / frame["file_path"].replace("images", folder)).parent.mkdir(parents=True, exist_ok=True)
        (data / frame["file_path"]).write_bytes((rig / frame["file_path"]).read_bytes())
        frame["mask_path"] = frame["file_path"].replace("images", "masks")
        Image.fromarray(given).save(data / frame["mask_path"])
    names = [frame["file_path"] for frame in meta["frames"]]
    splits = {"train_filenames": names[2:], "val_filenames": names[:2], "test_filenames": names[:2]}
    (data / "transforms.json").write_text(json.dumps({**meta, **splits}))
    (data / "sparse_pc.ply").write_bytes((rig / "sparse_pc.ply").read_bytes())
    folder = export(data, tmp_path / "out", "nerfstudio")
    train, test = (opened(folder / name.replace("images", "masks")) > 0 for name in (names[2], names[0]))
    assert agree(train, true_mask("front", "raw") & (given > 0))
    assert np.array_equal(test, given > 0)
    written = json.loads((folder / "transforms.json").read_text())
    assert written["test_filenames"] == names[:2]
    other = export(data, tmp_path / "other", "colmap")
    assert len(pycolmap.Reconstruction(other / "sparse/0").images) == 2 * VIEWS - 2
    assert "Left out: 2 test photos of the dataset." in (other / "README.md").read_text()


def test_without_a_training_the_detected_artifact_is_masked(tiny_scene, tmp_path, draw_effect):
    main(["export-dataset", "--for", "brush", "--data", str(tiny_scene), "--output", str(tmp_path / "out")])
    hidden = draw_effect("dashboard", 48, 64).transmittance.min(axis=-1) < 0.05
    mask = opened(next((tmp_path / "out/masks").rglob("*.png"))) > 0
    assert (~mask)[hidden].mean() > 0.9
    assert mask[~hidden].mean() > 0.9


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], "give --load-config of a run, or --data of a dataset"),
        (["--data", "DATA", "--photos", "cleaned"], "add --load-config"),
        (["--data", "DATA", "--threshold", "1"], "--threshold must be in (0, 1)"),
        (["--data", "DATA", "--load-config", "OTHER"], "is of no camera of the run"),
        (["--load-config", "OTHER"], "cannot be read"),
    ],
)
def test_what_cannot_be_exported(tiny_scene, tmp_path, capsys, options, expected):
    config = checkpoint(tmp_path / "run")
    values = {"DATA": str(tiny_scene), "OTHER": str(config)}
    lens = Lens(40, 80, 50, 50, 20, 40)
    overlay = OracleOverlay(torch.ones(80, 40, 3), torch.zeros(80, 40, 3))
    write_run(tmp_path / "run", cameras([(overlay, lens)]))
    words = [str(values.get(word, word)) for word in options]
    with pytest.raises(SystemExit) as caught:
        main(["export-dataset", "--for", "brush", "--output", str(tmp_path / "out"), *words])
    assert caught.value.code == 2
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_3dgrut_is_not_given_a_lens_that_it_does_not_read(rig, tmp_path, capsys):
    with pytest.raises(SystemExit):
        export(rig, tmp_path / "out", "3dgrut", "--frame", "raw")
    assert "3DGRUT does not read this lens" in capsys.readouterr().err


def test_a_fisheye_goes_through_raw_and_undistorted(tmp_path, photos):
    """3DGRUT reads it as it is; a panel in the middle keeps its place in both frames."""
    lens = Lens(WIDTH, HEIGHT, 120, 120, 112, 84, (0.05, 0.01, 0, 0, 0, 0), "fisheye")
    target = undistorted_lens(lens)
    transmittance = torch.ones(target.height, target.width, 3)
    transmittance[60:110, 80:140] = 0
    overlay = OracleOverlay(transmittance, 0.3 * (1 - transmittance))
    config = write_run(tmp_path / "run", cameras([(overlay, lens)]))
    data = tmp_path / "data"
    (data / "images").mkdir(parents=True)
    frames = []
    for number, (photo, pose) in enumerate(zip(photos(2), poses(2), strict=True)):
        Image.fromarray(photo).save(data / f"images/{number}.png")
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": pose.tolist()})
    intrinsics = {"w": WIDTH, "h": HEIGHT, "fl_x": 120, "fl_y": 120, "cx": 112, "cy": 84, "k1": 0.05, "k2": 0.01}
    meta = {"camera_model": "OPENCV_FISHEYE", **intrinsics, "k3": 0, "k4": 0, "frames": frames}
    (data / "transforms.json").write_text(json.dumps(meta))
    scene = transmittance[..., 0].numpy()
    for frame, model, true in (("raw", "OPENCV_FISHEYE", distort(scene, lens, 1.0)), ("auto", "PINHOLE", scene)):
        folder = tmp_path / frame
        main(["export-dataset", "--for", "3dgrut", "--load-config", str(config), "--data", str(data), "--output",
              str(folder), "--frame", frame])  # fmt: skip
        (camera,) = pycolmap.Reconstruction(folder / "sparse/0").cameras.values()
        assert camera.model.name == model
        assert agree(opened(folder / "images/1_mask.png") > 0, true > 0.5)


def test_detection_alone_restores_no_photo():
    lens = LENSES["front"]
    photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    detection: Any = SimpleNamespace(mask=torch.zeros(HEIGHT, WIDTH, dtype=torch.bool))
    with pytest.raises(InputError, match="not its color; give --load-config"):
        DetectedArtifact([lens], [detection]).restored(photo, "images/0.png", lens, "raw")


def test_every_preset_says_where_it_comes_from():
    for preset in PRESETS.values():
        assert preset.sources
        assert any(re.search(r"https://", source) for source in preset.sources)
