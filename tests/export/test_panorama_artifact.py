"""The faces' overlays as one artifact in the frame of the 360 photos, through the command, without training."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from small_checkpoints import cameras, write_run
from wide_captures import operator

from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.cameras.panorama import Face, cut, panorama_faces
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.panorama_entry import panorama_entry
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.artifact_layers import undistorted_layers
from ssa_nerfstudio.export.checkpoint import Checkpoint
from ssa_nerfstudio.export.panorama_artifact import panorama_layers, panorama_of
from ssa_nerfstudio.overlay.layer import OracleOverlay

WIDTH = 512
COLOR = np.array([0.8, 0.4, 0.2], np.float32)


def run_of(folder: Path, faces: tuple[Face, ...], covered: tuple[str, ...], reduced: int = 1) -> Path:
    """A run whose overlays are the operator's in the faces `covered`, and the dataset beside it."""
    pairs = []
    for face in faces:
        if face.name in covered:
            small = Face(face.name, face.size // reduced)
            matte = torch.from_numpy(cut(operator(WIDTH), small).reshape(small.size, small.size, 1))
            overlay = OracleOverlay((1 - matte).expand(-1, -1, 3).clone(), matte * torch.from_numpy(COLOR))
            middle = small.size / 2
            pairs.append((overlay, Lens(small.size, small.size, small.focal, small.focal, middle, middle)))
    frame = {"file_path": "images/0.png", "w": 1, "h": 1, "fl_x": 1, "fl_y": 1, "cx": 0, "cy": 0}
    (folder / "data").mkdir(parents=True)
    (folder / "data/transforms.json").write_text(json.dumps({"frames": [frame], **panorama_entry(WIDTH, faces)}))
    return write_run(folder / "run", cameras(pairs))


def export(folder: Path, config: Path, *options: str) -> Path:
    output = folder / "artifact"
    words = ["--load-config", str(config), "--output", str(output), "--equirectangular", "--data", str(folder / "data")]
    main(["export-overlay", *words, *options])
    return output


@pytest.mark.parametrize("reduced", [1, 2])
def test_overlays_of_faces_are_one_artifact_and_faces_without_one_are_clear(tmp_path, reduced):
    config = run_of(tmp_path, panorama_faces(WIDTH), ("back", "left", "right", "down"), reduced)
    output = export(tmp_path, config)
    rgba = np.asarray(Image.open(output / "overlay.png")).astype(float) / 255
    true = operator(WIDTH)[..., 0]
    if reduced > 1:
        true = np.asarray(Image.fromarray(true).resize((rgba.shape[1], rgba.shape[0]), Image.Resampling.BOX))
    assert rgba.shape[1] == WIDTH // reduced
    assert np.abs(rgba[..., 3] - true).mean() < 0.01
    inside = true == 1
    assert np.abs(rgba[inside][:, :3] - COLOR).mean() < 0.01
    (camera,) = json.loads((output / "overlay.json").read_text())["cameras"]
    assert camera["frame"] == "equirectangular"
    assert not (output / "layers.npz").exists()


def test_a_face_that_was_left_out_is_clear_and_its_mask_goes_on(tmp_path):
    """Nobody looked down: the artifact is not known there, but masks must not let features in."""
    config = run_of(tmp_path, panorama_faces(WIDTH, ("down",)), ("back", "left", "right", "front"))
    output = export(tmp_path, config)
    assert not np.asarray(Image.open(output / "matte.png"))[-1].any()
    lowest = np.asarray(Image.open(output / "mask_white_is_scene.png"))[-1]
    assert not lowest[: WIDTH // 16].any(), "below the operator's body"
    assert lowest[WIDTH // 2] == 255


def test_panoramas_are_restored_outside_of_the_artifact(tmp_path):
    config = run_of(tmp_path, panorama_faces(WIDTH), ("back", "left", "right", "down"))
    rng = np.random.default_rng(0)
    clean = np.kron(rng.integers(0, 200, (32, 64, 3)), np.ones((8, 8, 1)))
    matte = operator(WIDTH)
    (tmp_path / "photos").mkdir()
    marred = np.rint(clean * (1 - matte) + matte * COLOR * 255).astype(np.uint8)
    Image.fromarray(marred).save(tmp_path / "photos/0.png")
    output = export(tmp_path, config, "--apply", str(tmp_path / "photos"))
    restored = np.asarray(Image.open(output / "photos/0.png"))
    seen = np.asarray(Image.open(output / f"mask_white_is_scene_{WIDTH}x{WIDTH // 2}.png"))
    assert not seen[matte[..., 0] > 0.9].any()
    assert seen[matte[..., 0] == 0].mean() > 0.95
    assert np.abs(restored[seen].astype(float) - clean[seen]).max() < 20


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({}, "was not made of equirectangular photos; leave --equirectangular out"),
        ({"panorama": {"w": 8}}, "panorama is not what ssa process writes"),
        ({"panorama": {"w": 8, "face_size": 2, "faces": ["sideways"]}}, "panorama is not what ssa process writes"),
    ],
)
def test_a_dataset_of_other_photos_is_refused(tmp_path, capsys, entry, message):
    config = run_of(tmp_path, panorama_faces(WIDTH), ("down",))
    path = tmp_path / "data/transforms.json"
    path.write_text(json.dumps({"frames": json.loads(path.read_text())["frames"], **entry}))
    with pytest.raises(SystemExit) as caught:
        export(tmp_path, config)
    assert caught.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "artifact").exists()


def test_a_face_whose_artifact_changes_is_refused(tmp_path):
    config = run_of(tmp_path, panorama_faces(WIDTH), ("back", "left", "right"))
    first, second, third = undistorted_layers(Checkpoint.read(config))
    panorama = panorama_of(tmp_path / "data")
    assert panorama_layers([first, second, third], panorama).frame == "equirectangular"
    later = replace(first, name="camera_0_interval_2", start="images/7.png")
    with pytest.raises(InputError, match="camera_0_interval_2"):
        panorama_layers([first, second, later, third], panorama)
