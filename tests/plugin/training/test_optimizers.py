"""All optimizers of a training: exact counts, and everything that nerfstudio's do."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

from ssa_nerfstudio.errors import TrainingError
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdamConfig
from ssa_nerfstudio.plugin.training.nonfinite import NonFiniteGuard
from ssa_nerfstudio.plugin.training.optimizers import JointOptimizers

LOSS = torch.ones(())
NO_SCALER = torch.amp.GradScaler("cpu", enabled=False)


def joint(guard: NonFiniteGuard | None = None, max_norm: float | None = None) -> tuple[JointOptimizers, list]:
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


def test_steps_are_counted_where_they_are_taken_and_nowhere_else(caplog):
    """A rig: each camera's overlay has gradients at steps of its own; a skip belongs to the step it happened at."""
    guard = NonFiniteGuard(max_skipped_steps=100)
    optimizers, (a, b) = joint(guard)
    for step in range(12):
        optimizers.zero_grad_some(["a", "b"])
        assert a.grad is None
        assert b.grad is None
        here = a if step % 2 else b
        here.grad = torch.full((3,), math.nan if step in (3, 5, 7) else 1.0)
        optimizers.step_groups(["a", "b"], LOSS, NO_SCALER)
    assert counts(optimizers) == [3, 6]
    assert guard.check(11) == 3
    assert "skipped 3 of 12 steps up to 11" in caplog.text
    assert torch.isfinite(a).all()


@pytest.mark.parametrize("guarded", [True, False])
def test_what_a_group_asks_of_its_gradients_is_done(guarded):
    optimizers, (a, b) = joint(NonFiniteGuard(max_skipped_steps=100) if guarded else None, max_norm=0.5)
    a.grad, b.grad = torch.full((3,), 10.0), torch.full((3,), 0.1)
    optimizers.step_groups(["a", "b"], LOSS, NO_SCALER)
    assert a.grad.norm() == pytest.approx(0.5, rel=1e-4)
    assert counts(optimizers) == [1, 1]
    assert (a < 0).all()


def test_gradients_of_parameters_that_a_refinement_has_put_in_are_clipped():
    optimizers, _ = joint(max_norm=0.5)
    refined = torch.nn.Parameter(torch.zeros(5))
    optimizers.optimizers["a"].param_groups[0]["params"] = [refined]
    refined.grad = torch.full((5,), 10.0)
    optimizers.step_groups(["a", "b"], LOSS, NO_SCALER)
    assert refined.grad.norm() == pytest.approx(0.5, rel=1e-4)


def test_a_scaler_of_gradients_is_asked():
    optimizers, (a, b) = joint()
    scaler = torch.amp.GradScaler("cpu", init_scale=4.0)
    for value in (1.0, math.inf):
        scaler.scale(torch.ones(()))  # makes its state on first use
        a.grad, b.grad = torch.full((3,), 4 * value), torch.full((3,), 4.0)
        optimizers.step_groups(["a", "b"], LOSS, scaler)
        scaler.update()
    assert counts(optimizers) == [1, 2]
    assert optimizers.optimizers["a"].state[a]["exp_avg"][0] == pytest.approx(0.1)


def test_schedulers_find_optimizers_that_have_stepped():
    optimizers, (a, b) = joint()
    a.grad, b.grad = torch.ones(3), torch.ones(3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        optimizers.step_groups(["a", "b"], LOSS, NO_SCALER)
        optimizers.scheduler_step_all(0)
    assert optimizers.optimizers["a"].param_groups[0]["lr"] < 0.1


def test_a_check_with_nothing_judged_keeps_the_run_of_skips(caplog):
    guard = NonFiniteGuard(max_skipped_steps=20)
    optimizers, (a, b) = joint(guard)
    for _ in range(10):
        a.grad, b.grad = torch.full((3,), math.nan), torch.ones(3)
        optimizers.step_groups(["a", "b"], LOSS, NO_SCALER)
    assert guard.check(9) == 10
    assert "skipped 10 of 10 steps up to 9: the gradient of a was not finite" in caplog.text
    assert guard.check(9) == 0
    for _ in range(9):
        a.grad = torch.full((3,), math.nan)
        optimizers.step_groups(["a", "b"], LOSS, NO_SCALER)
    assert guard.check(18) == 9
    optimizers.step_groups(["a", "b"], LOSS, NO_SCALER)
    with pytest.raises(TrainingError, match="from step 0 on, were skipped because the gradient of a was"):
        guard.check(19)
