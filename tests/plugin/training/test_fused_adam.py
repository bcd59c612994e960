"""FusedAdam is torch's Adam to the last bit, and a skipped step leaves no trace."""

from __future__ import annotations

import copy

import pytest
import torch
from gsplat.strategy.ops import _update_param_with_optimizer

from ssa_nerfstudio.plugin.training.fused_adam import FusedAdam, FusedAdamConfig, count_steps


def two(lr: float = 0.1, **settings) -> tuple[list[torch.nn.Parameter], list[torch.optim.Optimizer]]:
    parameters = [torch.nn.Parameter(torch.linspace(-1, 1, 12).reshape(3, 4)) for _ in range(2)]
    ours = FusedAdam([parameters[0]], lr=lr, **settings)
    return parameters, [ours, torch.optim.Adam([parameters[1]], lr=lr, fused=True, **settings)]


@pytest.mark.parametrize("settings", [{"eps": 1e-15}, {"betas": (0.8, 0.95)}, {"weight_decay": 0.1}])
def test_it_is_torchs_to_the_last_bit(settings) -> None:
    (ours, torchs), optimizers = two(**settings)
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        gradient = torch.randn(3, 4, generator=generator)
        ours.grad, torchs.grad = gradient.clone(), gradient.clone()
        for optimizer in optimizers:
            optimizer.step()
    assert torch.equal(ours, torchs)
    states = [optimizer.state_dict()["state"][0] for optimizer in optimizers]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_a_skipped_step_changes_nothing_and_the_next_is_as_if_it_had_not_been() -> None:
    (ours, torchs), (optimizer, plain) = two()
    assert isinstance(optimizer, FusedAdam)
    for value, skipped in ((1.0, 0.0), (float("nan"), 1.0), (0.5, 0.0)):
        ours.grad = torch.full((3, 4), value)
        optimizer.found_inf = torch.tensor(skipped)  # pyright: ignore[reportAttributeAccessIssue]
        before = copy.deepcopy([ours.detach(), *optimizer.state[ours].values()])
        optimizer.step()
        if skipped:
            assert all(torch.equal(a, b) for a, b in zip(before, [ours, *optimizer.state[ours].values()], strict=True))
        else:
            torchs.grad = torch.full((3, 4), value)
            plain.step()
    assert torch.equal(ours, torchs)


def test_steps_that_are_counted_together_are_not_counted_again() -> None:
    parameters = [torch.nn.Parameter(torch.zeros(2)) for _ in range(3)]
    optimizers = [FusedAdam([parameter], lr=0.1) for parameter in parameters]
    for parameter in parameters[:2]:
        parameter.grad = torch.ones(2)
    count_steps([counter for optimizer in optimizers for counter in optimizer.counters()], torch.tensor(1.0))
    for optimizer in optimizers[:2]:
        with torch.no_grad():
            optimizer.update(None)
        optimizer.step()
    assert [float(optimizers[k].state[parameters[k]]["step"]) for k in (0, 1)] == [2, 2]
    assert parameters[2] not in optimizers[2].state


def test_states_are_exchanged_with_torchs() -> None:
    (ours, torchs), (optimizer, plain) = two()
    for parameter, mine in ((ours, optimizer), (torchs, plain)):
        parameter.grad = torch.ones(3, 4)
        mine.step()
    plain.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    optimizer.load_state_dict(copy.deepcopy(plain.state_dict()))
    for mine in (optimizer, plain):
        mine.step()
    assert torch.equal(ours, torchs)


def test_densification_can_put_other_gaussians_into_it() -> None:
    parameter = torch.nn.Parameter(torch.ones(3, 4))
    params, optimizers = {"means": parameter}, {"means": FusedAdamConfig(lr=0.1).setup(params=[parameter])}
    parameter.grad = torch.ones(3, 4)
    optimizers["means"].step()
    _update_param_with_optimizer(
        lambda _, p: torch.nn.Parameter(torch.cat([p, p])), lambda _, v: torch.cat([v, v]), params, optimizers
    )
    assert len(params["means"]) == 6
    params["means"].grad = torch.ones(6, 4)
    optimizers["means"].step()
    torch.testing.assert_close(params["means"].detach(), torch.full((6, 4), 0.8))


def test_a_parameter_without_gradient_waits() -> None:
    used, unused = (torch.nn.Parameter(torch.zeros(2)) for _ in range(2))
    optimizer = FusedAdam([used, unused], lr=0.1)
    used.grad = torch.ones(2)
    optimizer.step()
    assert (used < 0).all()
    assert (unused == 0).all()
    assert unused not in optimizer.state
