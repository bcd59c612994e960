"""Datasets that cannot be simulated on: one line with culprit and remedy, exit code 2, nothing written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_datasets import edit, write_dataset

from ssa_nerfstudio.cli import main

FIRST = "images/frame_000.jpg"


def refused(capsys: pytest.CaptureFixture[str], data: Path, *arguments: str) -> str:
    """The one line with which the command is refused; it must have left nothing beside the data."""
    output = data.parent / "out"
    arguments = arguments or ("--effects", "vignette")
    with pytest.raises(SystemExit) as caught:
        main(["simulate", "--data", str(data), "--output", str(output), *arguments])
    assert caught.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert not [path for path in data.parent.iterdir() if "out" in path.name]
    return lines[0]


def frames(data: Path) -> list[dict]:
    return json.loads((data / "transforms.json").read_text())["frames"]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:300])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: (data / "transforms.json").unlink(), "transforms.json does not exist; choose a folder"),
        (lambda data: (data / "transforms.json").write_text("{"), "is no valid JSON"),
        (lambda data: (data / "transforms.json").write_text("[]"), "has no list 'frames'"),
        (lambda data: edit(data, frames=[{"transform_matrix": []}]), "has no list 'frames'"),
        (lambda data: edit(data, frames=[{"file_path": 3}]), "has no list 'frames'"),
        (lambda data: edit(data, frames=[]), "leaves no photo to train on"),
        (lambda data: edit(data, frames=frames(data)[:1]), "leaves no photo to train on"),
        (lambda data: edit(data, frames=[*frames(data), frames(data)[0]]), "has two frames of images/frame_009.jpg"),
        (lambda data: edit(data, fl_x=None), "camera of images/frame_009.jpg: fl_x is missing"),
        (lambda data: edit(data, w="wide"), "w is no number: 'wide'"),
        (lambda data: edit(data, h=0), "frame must be at least 1 x 1 pixels"),
        (lambda data: edit(data, cx=float("nan")), "intrinsics must be finite"),
        (lambda data: edit(data, k1=float("inf")), "intrinsics must be finite"),
        (lambda data: edit(data, k1=0.1, k4=0.1), "nerfstudio undistorts no perspective camera with k4"),
        (lambda data: edit(data, k1=0.1, w=1), "leaves no pixel of 1 x 36"),
        (lambda data: edit(data, k1=-30.0, camera_model="OPENCV_FISHEYE"), "folds its frame"),
        (lambda data: edit(data, k1=0.1, camera_model="FISHEYE624"), "FISHEYE624 with distortion"),
        (lambda data: edit(data, w=50), "frame_001.jpg is 48 x 36, expected 50 x 36"),
        (lambda data: (data / "images/frame_003.jpg").unlink(), "frame_003.jpg does not exist; put the photo there"),
        (lambda data: (data / "images/frame_003.jpg").write_text("no"), "frame_003.jpg cannot be read as a photo"),
        (lambda data: truncate(data / "images/frame_003.jpg"), "frame_003.jpg cannot be read as a photo"),
        (lambda data: (data / "sparse_pc.ply").unlink(), "sparse_pc.ply cannot be read as sparse points (No such"),
        (lambda data: (data / "sparse_pc.ply").write_text(""), "remove ply_file_path from transforms.json"),
        (lambda data: edit(data, ply_file_path="../x.ply"), "../x.ply lies outside the dataset"),
        (lambda data: edit(data, train_filenames=[FIRST], test_filenames=[FIRST]), "both training and test view"),
        (
            lambda data: edit(data, train_filenames=["images/other.jpg"]),
            "train_filenames has images/other.jpg, which no",
        ),
        (lambda data: edit(data, test_filenames=3), "test_filenames must be a list of file paths"),
        (lambda data: edit(data, test_filenames=[frame["file_path"] for frame in frames(data)]), "leaves no photo"),
    ],
)
def test_what_is_wrong_with_a_dataset_is_named(damage: Callable[[Path], object], message, tmp_path, capsys):
    data = write_dataset(tmp_path / "data")
    damage(data)
    assert message in refused(capsys, data)


@pytest.mark.parametrize("mode", ["P", "I;16", "RGBA", "CMYK"])
def test_photos_that_are_not_8_bit_rgb_are_refused(mode, tmp_path, capsys):
    data = write_dataset(tmp_path / "data", suffix=".png")
    path = data / "images/frame_002.png"
    if mode == "I;16":
        Image.fromarray(np.zeros((36, 48), np.uint16)).save(path)
    elif mode == "RGBA":
        Image.new("RGBA", (48, 36), (9, 9, 9, 128)).save(path)
    else:
        Image.new(mode, (48, 36)).save(path, format="TIFF" if mode == "CMYK" else "PNG")
    assert "convert it to 8-bit RGB" in refused(capsys, data)


def test_two_photos_that_would_become_one_are_refused(tmp_path, capsys):
    data = write_dataset(tmp_path / "data", views=4)
    Image.new("RGB", (48, 36)).save(data / "images/frame_001.png")
    edit(data, frames=[*frames(data), {"file_path": "images/frame_001.png", "transform_matrix": np.eye(4).tolist()}])
    assert "would both be written to images/frame_001.png" in refused(capsys, data)


def test_an_output_that_exists_is_kept(tmp_path, capsys):
    data = write_dataset(tmp_path / "data")
    (tmp_path / "kept").mkdir()
    with pytest.raises(SystemExit) as caught:
        main(["simulate", "--data", str(data), "--output", str(tmp_path / "kept"), "--effects"])
    assert caught.value.code == 2
    assert "exists already" in capsys.readouterr().err
    assert not list((tmp_path / "kept").iterdir())


def test_an_output_that_cannot_be_written_is_named(tmp_path, capsys):
    data = write_dataset(tmp_path / "data")
    with pytest.raises(SystemExit) as caught:
        main(["simulate", "--data", str(data), "--output", str(data / "transforms.json/out"), "--effects"])
    assert caught.value.code == 2
    assert "cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--effects", "vignette", "--eval-interval", "1"], "--eval-interval must be at least 2, got 1"),
        (["--effects", "vignette", "--downscale-factor", "0"], "--downscale-factor must be at least 1, got 0"),
        (["--effects", "vignette", "--downscale-factor", "4"], "images_4/frame_000.jpg does not exist"),
        (["--effects", "vignette", "--seed", "-1"], "--seed must be at least 0, got -1"),
        (["--effects", "vignette", "--threads", "0"], "--threads must be at least 1, got 0"),
        (["--effects", "watermrk"], "effects has no 'watermrk' (did you mean 'watermark'?)"),
        (["--effects", "nowhere.yaml"], "nowhere.yaml does not exist"),
        (["--scene", "nothing"], "scenes has no 'nothing'; choose one of careless-phone"),
    ],
)
def test_bad_arguments_are_named(arguments, message, tmp_path, capsys):
    assert message in refused(capsys, write_dataset(tmp_path / "data"), *arguments)
