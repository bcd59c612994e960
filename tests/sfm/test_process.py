"""`ssa process` on photos whose cameras are known, with a dashboard in front of them and without."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.process_data.colmap_utils import colmap_to_json
from PIL import Image
from plyfile import PlyData
from small_captures import HEIGHT, WIDTH, poses, write

from benchmarks.sfm_accuracy import center_errors
from ssa_nerfstudio.cli import main

VIEWS = 16


@pytest.fixture(scope="module")
def covered(draw_effect, photos) -> list[np.ndarray]:
    layers = draw_effect("dashboard", HEIGHT, WIDTH)
    return [layers.apply(photo) for photo in photos(VIEWS)]


def process(*options: object) -> None:
    main(["process", "--threads", "1", *map(str, options)])


@pytest.fixture(scope="module")
def two_pass(tmp_path_factory, covered, draw_effect, photos) -> Path:
    """Every other view behind a dashboard, the others clean, through the command with a mask."""
    folder = tmp_path_factory.mktemp("capture")
    write(folder / "artifact", covered[::2])
    write(folder / "clean", photos(VIEWS)[1::2])
    transmittance = draw_effect("dashboard", HEIGHT, WIDTH).transmittance
    Image.fromarray(transmittance.min(axis=-1) > 0.9).save(folder / "mask.png")
    process(
        "--train", folder / "artifact", "--clean", folder / "clean", "--mask", folder / "mask.png",
        "--output", folder / "dataset",
    )  # fmt: skip
    return folder


def test_all_photos_of_both_passes_are_registered_in_one_frame(two_pass):
    meta = json.loads((two_pass / "dataset/transforms.json").read_text())
    found = {frame["file_path"]: np.array(frame["transform_matrix"]) for frame in meta["frames"]}
    names = [f"images/{kind}_{n // 2 + 1:05d}.png" for n in range(VIEWS) for kind in [("train", "clean")[n % 2]]]
    assert sorted(found) == sorted(names)
    true = poses(VIEWS)
    extent = np.linalg.norm(true[:, :3, 3] - true[:, :3, 3].mean(axis=0), axis=1).mean()
    errors = center_errors(np.array([found[name][:3, 3] for name in names]), true[:, :3, 3])
    assert errors.max() < 0.02 * extent
    # Directions too: between two views the rotation is the true one.
    for one, other in zip(range(VIEWS - 1), range(1, VIEWS), strict=True):
        turned = found[names[one]][:3, :3].T @ found[names[other]][:3, :3]
        np.testing.assert_allclose(turned, true[one, :3, :3].T @ true[other, :3, :3], atol=0.02)


def test_artifact_photos_train_and_clean_photos_test_and_all_are_the_users_bytes(two_pass):
    parser = NerfstudioDataParserConfig(data=two_pass / "dataset").setup()
    for split, folder, first in (("train", "artifact", 0), ("val", "clean", 1), ("test", "clean", 1)):
        outputs = parser.get_dataparser_outputs(split)
        assert [path.read_bytes() for path in outputs.image_filenames] == [
            (two_pass / folder / f"photo_{n}.png").read_bytes() for n in range(VIEWS // 2)
        ], (split, first)
        true = WIDTH / 2 / np.tan(np.radians(65 / 2))
        np.testing.assert_allclose(outputs.cameras.fx.numpy(), true, rtol=0.05)
        assert {*outputs.cameras.width.flatten().tolist()} == {WIDTH}


def test_the_dataset_is_the_one_that_nerfstudio_would_have_made_of_the_same_model(two_pass, tmp_path):
    colmap_to_json(two_pass / "dataset/colmap/sparse/0", tmp_path)
    ours, theirs = (json.loads((folder / "transforms.json").read_text()) for folder in (two_pass / "dataset", tmp_path))
    for key in ("applied_transform", "ply_file_path"):
        assert ours[key] == theirs[key]
    frames = {frame["file_path"]: frame for frame in theirs["frames"]}
    assert len(ours["frames"]) == len(frames) == VIEWS
    for frame in ours["frames"]:
        np.testing.assert_allclose(frame["transform_matrix"], frames[frame["file_path"]]["transform_matrix"], atol=1e-9)
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"):
            assert frame[key] == frames[frame["file_path"]][key]
    clouds = [PlyData.read(str(folder / "sparse_pc.ply"))["vertex"] for folder in (two_pass / "dataset", tmp_path)]
    for names, tolerance in ((("x", "y", "z"), 1e-3), (("red", "green", "blue"), 0)):
        tables = [np.sort(np.stack([cloud[name] for name in names], 1).astype(float), axis=0) for cloud in clouds]
        np.testing.assert_allclose(tables[0], tables[1], atol=tolerance)
    assert len(clouds[0]) > 200


def test_a_killed_run_goes_on_where_it_was(tmp_path, capsys, photos):
    """A real process, killed with SIGKILL when its features are done; nothing of it looks like a dataset.

    While it runs, a second one is refused and leaves the work alone.
    """
    write(tmp_path / "photos", photos(12))
    command = [sys.executable, "-m", "ssa_nerfstudio", "process", "--threads", "1"]
    command += ["--train", str(tmp_path / "photos"), "--output", str(tmp_path / "out")]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert running.stdout is not None
    next(line for line in running.stdout if line.startswith("features"))
    with pytest.raises(SystemExit) as caught:
        process("--train", tmp_path / "photos", "--output", tmp_path / "out")
    assert caught.value.code == 2
    assert "another ssa process is at work" in capsys.readouterr().err
    (child,) = psutil.Process(running.pid).children()
    running.kill()
    running.wait()
    child.wait(5)
    assert not (tmp_path / "out").exists()
    assert list(tmp_path.glob(".out.work/motion/database.db"))
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "12 of 12 photos registered" in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "photos"]


def test_an_opaque_artifact_is_detected_and_masked(tmp_path, capsys, covered, draw_effect):
    write(tmp_path / "photos", covered)
    process("--train", tmp_path / "photos", "--output", tmp_path / "out", "--detect", "--no-flatten")
    said = capsys.readouterr().out
    assert f"{VIEWS} of {VIEWS} photos registered" in said
    used = np.asarray(Image.open(tmp_path / "out/mask_colmap.png"))
    true = draw_effect("dashboard", HEIGHT, WIDTH).transmittance.min(axis=-1) > 0.9
    assert used.shape == true.shape
    both, either = (~used & ~true).sum(), (~used | ~true).sum()
    assert both / either > 0.8
