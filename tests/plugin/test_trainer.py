"""What a training says last: after ctrl+c, and of its artifact."""

from __future__ import annotations

import copy
import sys
from types import SimpleNamespace

import pytest

from ssa_nerfstudio.errors import TrainingStopped
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.methods import METHODS
from ssa_nerfstudio.plugin.trainer import SSATrainer
from ssa_nerfstudio.plugin.training.densification import MarkovChainMonteCarlo


@pytest.fixture
def trainer(tmp_path, monkeypatch):
    """A trainer of `ns-train` that is at step 25; nothing is set up."""
    monkeypatch.setattr(sys, "argv", ["ns-train", "ssa-splatfacto", "--data", "photos"])
    made = SSATrainer.__new__(SSATrainer)
    made.config = copy.deepcopy(METHODS["ssa-splatfacto"])
    made.config.timestamp, made.config.experiment_name = "now", "photos"
    made.checkpoint_dir, made.step, made.training_state = tmp_path, 25, "training"
    return made


@pytest.mark.parametrize(
    ("steps", "scale_schedules", "expected"), [(7_000, True, "mcmc"), (7_000, False, "mcmc"), (6_999, True, "adc")]
)
def test_the_trainer_settles_the_densification_by_the_length_and_changes_no_configuration(
    steps, scale_schedules, expected, tiny_scene, tmp_path, configure_training, capsys
):
    model = {"overlay": "off", "num_downscales": 0}
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, steps, model)
    config.scale_schedules = scale_schedules
    config.set_timestamp()
    before = copy.deepcopy(config)
    trainer = SSATrainer(config)
    trainer.setup()
    assert trainer.pipeline.model.config.strategy == expected
    assert bool(trainer.pipeline.model.by_mcmc) == isinstance(trainer.pipeline.model.strategy, MarkovChainMonteCarlo)
    assert ("Densification: MCMC with at most" in capsys.readouterr().out) == (expected == "mcmc")
    assert config == before


def test_ctrl_c_says_from_which_step_the_training_goes_on(trainer, tmp_path):
    for step in (10, 20):
        (tmp_path / f"step-{step:09d}.ckpt").touch()
    with pytest.raises(TrainingStopped) as stopped, trainer._stopped_in_one_line():
        raise KeyboardInterrupt
    resumed = f"ns-train ssa-splatfacto --load-dir {tmp_path} --data photos"
    assert str(stopped.value) == f"at step 25; go on from step 20: {resumed}"


def test_ctrl_c_before_the_first_checkpoint(trainer):
    with pytest.raises(TrainingStopped) as stopped, trainer._stopped_in_one_line():
        raise KeyboardInterrupt
    assert str(stopped.value) == "at step 25, before the first checkpoint; start again"


def test_ctrl_c_after_the_training_closes_the_viewer(trainer):
    trainer.training_state = "completed"
    with trainer._stopped_in_one_line():
        raise KeyboardInterrupt


@pytest.mark.parametrize(("overlay", "why"), [("off", "the overlay was off"), ("auto", "none was detected")])
def test_the_last_line_says_why_there_is_no_artifact(trainer, overlay, why, capsys):
    trainer.config.pipeline.model.overlay = overlay
    trainer.pipeline = SimpleNamespace(model=SimpleNamespace(artifacts=Artifacts()))
    trainer._report_artifact(25)
    splats, artifact = capsys.readouterr().out.splitlines()
    assert (
        splats
        == "Splats: ssa export-splats --load-config outputs/photos/ssa-splatfacto/now/config.yml --output-dir splats"
    )
    assert artifact == f"Artifact: {why}, no overlay was trained"
