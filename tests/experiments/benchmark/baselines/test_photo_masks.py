"""Masks for all photos: which pixels they hide, that nerfstudio leaves those out, and what that restores."""

from __future__ import annotations

import json
import shutil
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from baselines.training import train
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Capture
from ssa_nerfstudio.experiments.benchmark.baselines.photo_masks import MASK, write_dataset

TRUE = {"mask_from": "truth"}


def area(folder) -> np.ndarray:
    """What a dataset's mask hides, bool [H, W]."""
    stated = {frame["mask_path"] for frame in json.loads((folder / "transforms.json").read_text())["frames"]}
    assert stated == {f"ignored/{MASK}"}
    return np.asarray(Image.open(folder / "ignored" / MASK)) == 0


def test_the_true_mask_is_where_the_simulated_artifact_can_be_seen(capture, tmp_path):
    write_dataset(Capture(capture("watermark"), "watermark", None, TRUE), tmp_path / "masked")
    hidden = area(tmp_path / "masked")
    with np.load(capture("watermark") / "layers" / "raw.npz") as layers:
        touched = (layers["T"] < 1).any(axis=2)
    assert hidden[~touched].sum() == 0
    assert 0.5 < hidden[touched].mean() <= 1
    assert 0.02 < hidden.mean() < 0.5


def test_the_true_mask_holds_what_only_adds_light(capture, tmp_path):
    write_dataset(Capture(capture("rain"), "rain", None, TRUE), tmp_path / "masked")
    with np.load(capture("rain") / "layers" / "raw.npz") as layers:
        assert (layers["T"] == 1).all()
        bright = (layers["B"] > 0.1).any(axis=2)
    assert bright.any()
    assert area(tmp_path / "masked")[bright].all()


def test_the_true_mask_of_a_real_artifact_is_the_benchmarks(capture, tmp_path):
    Image.fromarray(np.kron(np.eye(2, dtype=np.uint8) * 255, np.ones((24, 32), np.uint8))).save(tmp_path / "mask.png")
    write_dataset(Capture(capture("clean"), "finger", tmp_path / "mask.png", TRUE), tmp_path / "masked")
    hidden = area(tmp_path / "masked")
    assert hidden[:24, :32].all()
    assert hidden[24:, 32:].all()
    assert hidden.mean() == 0.5


def test_a_mask_that_hides_everything_is_refused_and_leaves_nothing(capture, tmp_path):
    Image.new("L", (64, 48), 255).save(tmp_path / "mask.png")
    with pytest.raises(InputError, match="covers every pixel"):
        write_dataset(Capture(capture("clean"), "finger", tmp_path / "mask.png", TRUE), tmp_path / "masked")
    assert not (tmp_path / "masked").exists()


def test_the_detected_mask_covers_a_dashboard_and_nothing_of_clean_photos(capture, tmp_path):
    for kind in ("dashboard", "clean"):
        made = Capture(capture(kind), kind, None, {"mask_from": "detection"})
        write_dataset(made, tmp_path / kind)
    with np.load(capture("dashboard") / "layers" / "raw.npz") as layers:
        true = (layers["T"] < 0.5).any(axis=2)
    found = area(tmp_path / "dashboard")
    assert (found & true).sum() / (found | true).sum() > 0.8
    assert not area(tmp_path / "clean").any()


@pytest.mark.parametrize("mask_from", ["truth", "detection"])
def test_several_cameras_are_refused_though_their_photos_have_one_size(capture, tmp_path, mask_from):
    folder = shutil.copytree(capture("dashboard"), tmp_path / "rig")
    meta = json.loads((folder / "transforms.json").read_text())
    length = meta.pop("fl_x")
    for number, frame in enumerate(meta["frames"]):
        frame["fl_x"] = length * (1.0 + 0.2 * (number % 2))
    (folder / "transforms.json").write_text(json.dumps(meta))
    with pytest.raises(InputError, match="several cameras"):
        write_dataset(Capture(folder, "dashboard", None, {"mask_from": mask_from}), tmp_path / "masked")


def test_the_loss_leaves_out_what_is_masked(capture, tmp_path):
    _, pipeline = train("mask-true", capture("dashboard"), tmp_path, 2)
    camera, batch = pipeline.datamanager.next_train(0)
    pipeline.model.train()
    outputs = pipeline.model.get_outputs(camera)
    hidden = torch.from_numpy(area(next((tmp_path / "mask-true").glob("scenes/*photo_masks*"))))
    assert torch.equal(batch["mask"][..., 0], ~hidden)
    changed: dict[str, Any] = {**outputs}
    changed["rgb"] = torch.where(hidden[..., None], 1.0 - changed["rgb"], changed["rgb"])
    losses = [float(pipeline.model.get_loss_dict(each, batch)["main_loss"].detach()) for each in (outputs, changed)]
    assert losses[0] == pytest.approx(losses[1])


@pytest.mark.slow
def test_a_mask_restores_what_a_dashboard_spoiled(gain):
    assert gain("mask-true", "dashboard") > 0.5
    assert gain("mask-detected", "dashboard") > 0.5
