"""Steps of all optimizers that are recorded against plain ones."""

from __future__ import annotations

import math

import pytest
import torch
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

from ssa_nerfstudio._system.in_place_graphs import RecordedChanges
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdamConfig
from ssa_nerfstudio.plugin.training.nonfinite import NonFiniteGuard
from ssa_nerfstudio.plugin.training.optimizers import JointOptimizers
from ssa_nerfstudio.plugin.training.recorded_steps import RecordedSteps

NO_SCALER = torch.amp.GradScaler("cpu", enabled=False)
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"))]


def make(device: str, guarded: bool) -> JointOptimizers:
    schedule = ExponentialDecaySchedulerConfig(lr_final=0.01, max_steps=20)
    config = {
        name: {"optimizer": FusedAdamConfig(lr=rate), "scheduler": schedule if name == "a" else None}
        for name, rate in (("a", 0.1), ("b", 0.02), ("unused", 1.0))
    }
    parameters = {name: [torch.nn.Parameter(torch.arange(5.0, device=device))] for name in config}
    return JointOptimizers(config, parameters, NonFiniteGuard(100) if guarded else None)


@pytest.mark.parametrize("guarded", [True, False])
@pytest.mark.parametrize("device", DEVICES)
def test_recorded_steps_move_parameters_as_plain_ones_do(monkeypatch, caplog, device, guarded):
    """Gradients stay in one place for ten steps, with one that is not finite, then in another."""
    results = []
    for recorded in (False, True):
        optimizers, fits = (
            make(device, guarded),
            staticmethod(lambda found, recorded=recorded: recorded and bool(found)),
        )
        monkeypatch.setattr("ssa_nerfstudio.plugin.training.optimizers.graphs_are_usable", lambda: True)
        monkeypatch.setattr(RecordedSteps, "fits", fits)
        if device == "cpu":
            monkeypatch.setattr(RecordedChanges, "__call__", lambda self, program, key: program())
        generator = torch.Generator().manual_seed(0)
        for step in range(20):
            if step % 10 == 0:
                held = {name: torch.zeros(5, device=device) for name in "ab"}
            for name, gradient in held.items():
                optimizers.parameters[name][0].grad = gradient.copy_(torch.randn(5, generator=generator))
            if guarded and step == 7:
                held["a"][2] = math.inf
            optimizers.step_groups(list(optimizers.parameters), torch.tensor(0.5, device=device), NO_SCALER)
            optimizers.scheduler_step_all(step)
        if guarded:
            assert optimizers.guard is not None
            assert optimizers.guard.check(19) == 1
        states = [each for o in optimizers.optimizers.values() for v in o.state.values() for each in v.values()]
        results.append([*(p.detach() for group in optimizers.parameters.values() for p in group), *states])
        if device == "cuda" and recorded:
            assert sum(each is not None for each in optimizers._recorded._changes._known.values()) == 2
    torch.testing.assert_close(results[0], results[1], rtol=1e-5, atol=1e-7)


def test_what_cannot_be_recorded_is_taken_plainly(monkeypatch):
    monkeypatch.setattr("ssa_nerfstudio.plugin.training.optimizers.graphs_are_usable", lambda: True)
    monkeypatch.setattr(RecordedSteps, "__call__", lambda *arguments: pytest.fail("it was recorded"))
    optimizers = make("cpu", guarded=True)
    optimizers.parameters["a"][0].grad = torch.ones(5)
    optimizers.step_groups(["a", "b"], torch.ones(()), NO_SCALER)  # on a CPU
    monkeypatch.setattr(RecordedSteps, "fits", staticmethod(lambda found: True))
    optimizers.step_groups(["b"], torch.ones(()), NO_SCALER)  # a's gradient accumulates
    assert optimizers.optimizers["a"].state[optimizers.parameters["a"][0]]["step"] == 1
