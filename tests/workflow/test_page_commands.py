"""The commands that a run's page lists: each is taken by the command that it calls."""

from __future__ import annotations

import importlib
import os
import shlex
import shutil
from pathlib import Path

import pytest
import torch
from rich.console import Console

from ssa_nerfstudio.cli import arguments, run
from ssa_nerfstudio.plugin.methods import METHODS
from ssa_nerfstudio.workflow.choices import Choices
from ssa_nerfstudio.workflow.finished_training import Evaluation, PicturedGroup
from ssa_nerfstudio.workflow.photos_to_splats import DATASET


def evaluation(tested: bool = True, overlay: bool = True) -> Evaluation:
    """Of a run with one camera."""
    metrics = {"psnr": 20.0}
    views = {"images/1.png": metrics} if tested else {}
    return Evaluation(metrics if tested else {}, views, False, [PicturedGroup("camera_0", "a" if overlay else None)])


def test_commands_of_ssa_are_taken_with_the_paths_of_the_run(tiny_scene, tmp_path):
    output, photos = tmp_path / "out", tmp_path / "my photos"
    shutil.copytree(tiny_scene, output / DATASET)
    choices = Choices(photos, "ssa-splatfacto", 120, 1.0, ("--draws", "300"), ("--threads", "1"))
    config = output / "training/ssa-splatfacto/config.yml"
    read = {}
    for name, command in choices.commands(output, config, evaluation()).items():
        program, called, *options = shlex.split(command)
        if program == "ssa":
            module = importlib.import_module(f"ssa_nerfstudio.cli.{called.replace('-', '_')}")
            read[name] = arguments.read(module.Command, options, f"ssa {called}", "")
    assert (read["Detect"].data, read["Detect"].draws) == (Path("../my photos"), 300)
    assert (read["Poses"].train, read["Poses"].output) == (Path("../my photos"), Path("again/dataset"))
    assert read["Poses"].threads == 1
    assert read["Splats"].load_config == Path("training/ssa-splatfacto/config.yml")


def test_a_run_without_test_photos_offers_no_evaluation(tiny_scene, tmp_path):
    choices, config = Choices(tiny_scene, "ssa-splatfacto", 120, 1.0), tmp_path / "training/config.yml"
    assert "Evaluate" in choices.commands(tmp_path, config, evaluation())
    assert "Evaluate" not in choices.commands(tmp_path, config, evaluation(tested=False))


def test_a_run_without_an_overlay_offers_nothing_that_needs_one(tiny_scene, tmp_path):
    choices, config = Choices(tiny_scene, "ssa-splatfacto", 120, 1.0), tmp_path / "training/config.yml"
    learned, alone = (choices.commands(tmp_path, config, evaluation(overlay=overlay)) for overlay in (True, False))
    (overlay,) = learned.keys() - alone.keys()
    assert "export-overlay" in learned[overlay]
    (capture,) = (command for command in alone.values() if "export-dataset" in command)
    assert "--load-config" not in capture
    assert str(os.path.relpath(tiny_scene, tmp_path)) in capture


@pytest.mark.parametrize("method", METHODS)
def test_with_a_gpu_a_method_has_its_own_number_of_steps(method, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for asked, expected in ((None, METHODS[method].max_num_iterations), (7, 7)):
        choices, plan = run.Command(tiny_scene, tmp_path / "out", method, asked)._plan(Console(quiet=True))
        assert choices.steps == plan.training.max_num_iterations == expected


@pytest.mark.parametrize(("steps", "saved_every"), [(10, 1), (2_000, 100), (30_000, 1_500), (200_000, 2_000)])
def test_a_training_that_is_killed_loses_a_twentieth_and_2000_steps_at_most(steps, saved_every, tiny_scene, tmp_path):
    options = Choices(tiny_scene, "ssa-splatfacto", steps, 1.0).training_options(tmp_path)
    assert options[options.index("--steps-per-save") + 1] == str(saved_every)
