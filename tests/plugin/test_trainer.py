"""What a training says last: after ctrl+c or SIGTERM, and of its artifact."""

from __future__ import annotations

import copy
import signal
import sys
from types import SimpleNamespace

import pytest

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.methods import METHODS
from ssa_nerfstudio.plugin.trainer import SSATrainer
from ssa_nerfstudio.plugin.training.densification import MarkovChainMonteCarlo
from ssa_nerfstudio.plugin.unfinished_run import no_config_left, stopped_in_one_line


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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("saved", "says"),
    [
        ((10, 20), "; go on from step 20: ns-train ssa-splatfacto --load-dir {folder} --data photos"),
        ((), ", before the first checkpoint; start again"),
    ],
)
def test_a_training_that_is_stopped_says_how_it_goes_on(number, saved, says, trainer, tmp_path, capsys):
    for step in saved:
        (tmp_path / f"step-{step:09d}.ckpt").touch()
    with pytest.raises(SystemExit) as end, stopped_in_one_line(trainer):
        signal.raise_signal(number)
    assert end.value.code == 128 + number
    assert capsys.readouterr().err == f"ssa-nerfstudio: stopped: at step 25{says.format(folder=tmp_path)}\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_training_that_is_stopped_before_it_began_leaves_no_run(number, trainer, tmp_path):
    trainer.base_dir = tmp_path / "outputs/photos/now"
    trainer.base_dir.mkdir(parents=True)
    (trainer.base_dir / "config.yml").touch()
    trainer.config.output_dir = tmp_path / "outputs"
    with pytest.raises(SystemExit), no_config_left(trainer), stopped_in_one_line(trainer):
        signal.raise_signal(number)
    assert list(tmp_path.rglob("*")) == [tmp_path / "outputs"]


def test_ctrl_c_after_the_training_closes_the_viewer(trainer):
    trainer.training_state = "completed"
    with stopped_in_one_line(trainer):
        raise KeyboardInterrupt


def test_a_log_in_that_fails_is_said_with_the_way_around_it(trainer, monkeypatch):
    def fail(*_: object) -> None:
        raise ValueError("set COMET_API_KEY to log in.")

    monkeypatch.setattr("nerfstudio.engine.trainer.Trainer.setup", fail)
    trainer.config.vis = "comet"
    trainer.base_dir = trainer.checkpoint_dir
    with pytest.raises(InputError, match=r"--vis comet: set COMET_API_KEY to log in; or choose --vis tensorboard$"):
        trainer.setup()


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
