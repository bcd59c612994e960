"""All optimizers of a training at once: exact counts, and everything that nerfstudio's do."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

from ssa_nerfstudio.errors import TrainingError
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdamConfig
from ssa_nerfstudio.plugin.training.nonfinite import StepGuard
from ssa_nerfstudio.plugin.training.optimizers import JointOptimizers

NO_SCALER = torch.amp.GradScaler("cpu", enabled=False)


def joint(guard: StepGuard | None = None, max_norm: float | None = None) -> tuple[JointOptimizers, list]:
    """Optimizers of two groups, a and b, of one parameter of three numbers each, and those."""
    parameters = [torch.nn.Parameter(torch.zeros(3)) for _ in range(2)]
    config = {
        name: {
            "optimizer": FusedAdamConfig(lr=0.1, max_norm=max_norm),
            "scheduler": ExponentialDecaySchedulerConfig(lr_final=0.01, max_steps=10),
        }
        for name in "ab"
    }
    groups = {name: [parameter] for name, parameter in zip("ab", parameters, strict=True)}
    return JointOptimizers(config, groups, guard), parameters


def counts(optimizers: JointOptimizers) -> list[float]:
    return [float(v["step"]) for o in optimizers.optimizers.values() for v in o.state.values()]


def test_steps_are_counted_where_they_are_taken_and_nowhere_else(capsys):
    """A rig: each camera's overlay has gradients at steps of its own; a skip belongs to the step it happened at."""
    guard = StepGuard(limit=100, magnified=False)
    optimizers, (a, b) = joint(guard)
    for step in range(12):
        optimizers.zero_grad_some(["a", "b"])
        broken = step in (3, 5, 7)
        here = a if step % 2 else b
        here.grad = torch.full((3,), math.nan if broken else 1.0)
        optimizers.optimizer_scaler_step_some(NO_SCALER, ["a", "b"])
    assert counts(optimizers) == [6, 6]
    optimizers.look(11)
    assert "3 of the 12 steps up to 11 were skipped" in capsys.readouterr().err
    optimizers.zero_grad_some(["a", "b"])
    a.grad = torch.full((3,), math.nan)  # another window; b was first in the one before
    optimizers.optimizer_scaler_step_some(NO_SCALER, ["a", "b"])
    optimizers.look(12)
    assert counts(optimizers) == [3, 6]
    assert torch.isfinite(a).all()
    optimizers.zero_grad_some(["a", "b"])
    assert a.grad is None
    assert b.grad is None


@pytest.mark.parametrize("guarded", [True, False])
def test_what_a_group_asks_of_its_gradients_is_done(guarded):
    optimizers, (a, b) = joint(StepGuard(limit=100, magnified=False) if guarded else None, max_norm=0.5)
    a.grad, b.grad = torch.full((3,), 10.0), torch.full((3,), 0.1)
    optimizers.optimizer_scaler_step_some(NO_SCALER, ["a", "b"])
    assert a.grad.norm() == pytest.approx(0.5, rel=1e-4)
    assert counts(optimizers) == [1, 1]
    assert (a < 0).all()


def test_a_scaler_of_gradients_is_asked():
    optimizers, (a, b) = joint()
    scaler = torch.amp.GradScaler("cpu", init_scale=4.0)
    for value in (1.0, math.inf):
        scaler.scale(torch.ones(()))  # makes its state on first use
        a.grad, b.grad = torch.full((3,), 4 * value), torch.full((3,), 4.0)
        optimizers.optimizer_scaler_step_some(scaler, ["a", "b"])
        scaler.update()
    assert counts(optimizers) == [1, 2]
    assert optimizers.optimizers["a"].state[a]["exp_avg"][0] == pytest.approx(0.1)


def test_schedulers_find_optimizers_that_have_stepped():
    optimizers, (a, b) = joint()
    a.grad, b.grad = torch.ones(3), torch.ones(3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        optimizers.optimizer_scaler_step_some(NO_SCALER, ["a", "b"])
        optimizers.scheduler_step_all(0)
    assert optimizers.optimizers["a"].param_groups[0]["lr"] < 0.1


def test_a_look_with_nothing_judged_forgets_no_row_and_names_nothing_it_cannot_know(capsys):
    guard = StepGuard(limit=20, magnified=False)
    parameters = {name: torch.nn.Parameter(torch.zeros(2)) for name in "ab"}
    plain = {name: torch.optim.Adam([parameter]) for name, parameter in parameters.items()}
    for optimizer in plain.values():
        guard.watch(optimizer)
    for _ in range(10):
        parameters["a"].grad, parameters["b"].grad = torch.full((2,), math.nan), torch.ones(2)
        guard.judge(plain)
        for optimizer in plain.values():
            optimizer.step()  # kept from its gradient
    assert guard.look(9) == list(range(10))
    assert "10 of the 10 steps up to 9 were skipped: the loss or a gradient was not finite" in capsys.readouterr().err
    assert guard.look(9) == []
    for _ in range(9):
        parameters["a"].grad = torch.full((2,), math.nan)
        guard.judge(plain)
    assert guard.look(18) == list(range(9))
    parameters["a"].grad = torch.full((2,), math.nan)
    guard.judge(plain)
    with pytest.raises(TrainingError, match="from step 0 on, were skipped because the gradient of a was"):
        guard.look(19)
