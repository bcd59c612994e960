"""The scripts that measure divergence and the guards' cost run on any machine."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks import divergence, guard_cost


@pytest.mark.slow
def test_divergence_is_noted_for_each_of_four_runs_and_drawn(tiny_scene, tmp_path):
    divergence.Command(data=tiny_scene, output=tmp_path, steps=20, cap_max=4200, every=5).run()
    runs = [json.loads(path.read_text()) for path in tmp_path.glob("*.json")]
    assert len({run["name"] for run in runs}) == 4
    for run in runs:
        assert run["verdict"] == "it does not diverge"
        assert run["noted"] == [0, 5, 10, 15]
        assert all(0 < value <= 1 for value in run["alive share"])
        assert all(value > 0 for value in run["gradient norm"])
    assert (tmp_path / "divergence.png").stat().st_size > 10_000


def test_a_parameter_that_breaks_is_named_with_its_step(tiny_scene, tmp_path, monkeypatch):
    from ssa_nerfstudio.plugin.model import SSASplatfactoModel

    original = SSASplatfactoModel.step_cb

    def break_one(model, optimizers, step):
        if step == 7 and not model.config.guards:
            model.quats.data[0] = float("nan")
        original(model, optimizers, step)

    monkeypatch.setattr(SSASplatfactoModel, "step_cb", break_one)
    run = divergence.Command(data=tiny_scene, output=tmp_path, steps=12, cap_max=4200, every=1)._train("off", False)
    assert run["verdict"].startswith("quats first not finite at step 7")


@pytest.mark.parametrize("overlay", ["on", "off"])
@pytest.mark.slow
def test_the_cost_of_the_guards_is_printed_with_its_interval(tiny_scene, capsys, overlay):
    guard_cost.Command(data=tiny_scene, overlay=overlay, grow=20, pairs=4).run()
    line = capsys.readouterr().out.strip().splitlines()[-1]
    assert "ms a step without guards; with them" in line
    assert "95 %" in line


def test_guards_that_are_switched_off_guard_nothing_and_switched_on_again_they_do(tiny_scene, tmp_path):
    training = guard_cost.Command(data=tiny_scene, overlay="on")._training(tmp_path)
    parameters = training.trainer.pipeline.model.gauss_params
    for guarded in (True, False, True):
        before = {name: values.detach().clone() for name, values in parameters.items()}
        parameters["features_dc"].data.fill_(float("nan"))
        training.switch(guarded)
        training.step()
        assert torch.equal(parameters["means"], before["means"]) == guarded
        for name, values in before.items():
            parameters[name].data.copy_(values)
