"""An artifact that comes half-way through a capture: an overlay for its interval, in training and afterwards."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from conftest import edit_transforms
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from ssa_nerfstudio.cameras.intervals import BEGINNING, interval_at
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.evidence.capture_detection import detect_artifacts
from ssa_nerfstudio.export.capture_artifact import LearnedArtifact
from ssa_nerfstudio.export.checkpoint import Checkpoint
from ssa_nerfstudio.plugin.model import SSASplatfactoModel
from ssa_nerfstudio.workflow.finished_training import PicturedGroup, evaluate, write_view_pictures
from ssa_nerfstudio.workflow.resumable_training import load_trained

HALF = 12


@pytest.fixture(scope="module")
def half(tmp_path_factory, write_built_in_scene, draw_effect) -> Path:
    """24 training views, the last 12 behind a dashboard, and two test views with a place in each half, as they are."""
    scene = write_built_in_scene(tmp_path_factory.mktemp("half") / "scene", views=26, test_views=1, width=64, height=48)
    layers = draw_effect("dashboard", 48, 64)
    photos = sorted(json.loads((scene / "transforms.json").read_text())["train_filenames"])
    for name in photos[HALF + 1 :]:
        clean = np.asarray(Image.open(scene / name), np.float32) / 255
        behind = layers.transmittance * clean + layers.addition
        Image.fromarray((behind.clip(0, 1) * 255).round().astype(np.uint8)).save(scene / name)
    test = [photos[6], photos[20]]
    edit_transforms(
        scene, train_filenames=[p for p in photos if p not in test], test_filenames=test, val_filenames=test
    )
    return scene


@pytest.fixture(scope="module")
def trained(half, tmp_path_factory, configure_training, train_and_evaluate):
    return train_and_evaluate(
        configure_training("ssa-splatfacto", half, tmp_path_factory.mktemp("run"), 20, {"num_downscales": 0})
    )


def test_the_interval_of_a_photo_is_the_last_that_begins_before_it():
    starts = ["images/0007.png", BEGINNING, "images/0003.png"]
    at = {name: interval_at(f"images_2/{name}", starts) for name in ("0001.png", "0003.png", "0006.png", "0900.png")}
    assert at == {"0001.png": 1, "0003.png": 2, "0006.png": 2, "0900.png": 0}
    assert interval_at("images/0001.png", starts[::2]) == 1
    unpadded = ["images/frame_10.png", "images/frame_9.png", BEGINNING]
    assert [interval_at(f"images/frame_{n}.png", unpadded) for n in (2, 9, 10, 11, 100)] == [2, 1, 0, 0, 0]


def test_photos_are_in_natural_order(half, tmp_path, configure_training):
    """By the order of text, frame_10 lies between frame_1 and frame_2, and nothing changes at one photo."""
    scene = Path(shutil.copytree(half, tmp_path / "scene"))
    meta = json.loads((scene / "transforms.json").read_text())
    frames = sorted(meta["frames"], key=lambda frame: frame["file_path"])
    names = {frame["file_path"]: f"images/frame_{number}.png" for number, frame in enumerate(frames)}
    for old, new in names.items():
        (scene / old).rename(scene / new)
    splits = {
        f"{split}_filenames": [names[p] for p in meta[f"{split}_filenames"]] for split in ("train", "test", "val")
    }
    edit_transforms(scene, frames=[{**f, "file_path": names[f["file_path"]]} for f in frames], **splits)
    (detection,) = detect_artifacts(scene, threads=1).values()
    assert len(detection.intervals) == 2
    config = configure_training("ssa-splatfacto", scene, tmp_path, 1, {"num_downscales": 0})
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    artifacts = trainer.pipeline.model.artifacts
    assert artifacts.starts[0] == "images/frame_14.png"
    photos = [path.name for path in trainer.pipeline.datamanager.train_dataset.image_filenames]
    carrying = {name for view, name in enumerate(photos) if artifacts.group_of_view(view) is not None}
    assert carrying == {f"frame_{number}.png" for number in range(14, 27)} - {"frame_21.png"}


def test_only_views_of_the_interval_have_an_overlay(trained, half):
    _, pipeline, _ = trained
    artifacts = pipeline.model.artifacts
    assert [artifacts.group_of_view(view) for view in range(24)] == [None] * HALF + [0] * HALF
    assert artifacts.changes
    assert artifacts.name(0) == "interval_2"
    pipeline.eval()
    clean, behind = (
        pipeline.model.get_outputs_for_camera(camera)
        for camera, _ in pipeline.datamanager.fixed_indices_eval_dataloader
    )
    assert torch.equal(clean["composite"], clean["rgb"])
    assert (behind["composite"] - behind["rgb"]).abs().mean() > 0.02


def test_a_loaded_training_pictures_every_interval_with_an_overlay(trained, half, tmp_path):
    """As `ssa run` does: the loaded model has never seen the training views."""
    loaded = load_trained(yaml.load(trained[2].read_text(), Loader=yaml.Loader))
    write_view_pictures(loaded, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"photo-1.jpg", "clean-1.jpg"}
    bottom = np.asarray(Image.open(tmp_path / "photo-1.jpg"), float)[40:]
    behind = [
        np.asarray(Image.open(path), float)[40:] for path in sorted((half / "images").glob("train_*"))[HALF + 1 :]
    ]
    assert np.abs(bottom - np.mean(behind, axis=0)).mean() < 10, "it is behind the dashboard"


def test_resuming_and_reloading_keep_the_intervals(trained, half, tmp_path, configure_training, train_and_evaluate):
    _, pipeline, config = trained
    resumed = configure_training("ssa-splatfacto", half, tmp_path, 22, {"num_downscales": 0})
    resumed.load_dir = config.parent / "nerfstudio_models"
    _, second, again = train_and_evaluate(resumed)
    views = [second.model.artifacts.group_of_view(view) for view in range(24)]
    assert views == [pipeline.model.artifacts.group_of_view(view) for view in range(24)]
    _, reloaded, _, _ = eval_setup(again, test_mode="inference")
    assert isinstance(reloaded.model, SSASplatfactoModel)
    assert reloaded.model.artifacts.starts == pipeline.model.artifacts.starts


def test_exports_know_which_photos_carry_it(trained, half, tmp_path):
    _, _, config = trained
    checkpoint = Checkpoint.read(config)
    artifact = LearnedArtifact(checkpoint, 0.5)
    covered = {view.path: artifact.covered(view.path, view.lens, "raw").any() for view in Dataset.read(half, 8).views}
    carrying = sorted(path for path, there in covered.items() if there)
    assert len(carrying) == HALF + 1
    assert carrying[0] == checkpoint.artifacts().starts[0]
    main(["export-overlay", "--load-config", str(config), "--output", str(tmp_path / "artifact")])
    (camera,) = json.loads((tmp_path / "artifact/overlay.json").read_text())["cameras"]
    assert (camera["name"], camera["photos_from"]) == ("interval_2", carrying[0])


def test_intervals_can_be_left_out(half, tmp_path, configure_training):
    config = configure_training(
        "ssa-splatfacto", half, tmp_path, 1, {"num_downscales": 0, "overlay": "on", "overlay_intervals": "off"}
    )
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    artifacts = trainer.pipeline.model.artifacts
    assert [artifacts.group_of_view(view) for view in range(24)] == [0] * 24


def test_one_that_is_replaced_has_an_overlay_for_each_interval(half, tmp_path, capsys, draw_effect, configure_training):
    scene = Path(shutil.copytree(half, tmp_path / "scene"))
    layers = draw_effect("ui", 48, 64)
    for name in sorted(json.loads((scene / "transforms.json").read_text())["train_filenames"])[:HALF]:
        clean = np.asarray(Image.open(scene / name), np.float32) / 255
        behind = layers.transmittance * clean + layers.addition
        Image.fromarray((behind.clip(0, 1) * 255).round().astype(np.uint8)).save(scene / name)
    config = configure_training("ssa-splatfacto", scene, tmp_path, 1, {"num_downscales": 0})
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    artifacts = trainer.pipeline.model.artifacts
    assert [artifacts.group_of_view(view) for view in range(24)] == [0] * HALF + [1] * HALF
    assert [artifacts.name(group) for group in range(2)] == ["interval_1", "interval_2"]
    assert "2 intervals" in " ".join(capsys.readouterr().out.split())
    trainer.pipeline.eval()
    write_view_pictures(trainer.pipeline, tmp_path)
    assert {path.name for path in tmp_path.glob("photo-*.jpg")} == {"photo-1.jpg", "photo-2.jpg"}
    assert evaluate(trainer.pipeline, scene, True, lambda *_: None).pictured == [
        PicturedGroup("from the first photo", "interval_1"),
        PicturedGroup(f"from {Path(artifacts.starts[1]).name}", "interval_2"),
    ]
