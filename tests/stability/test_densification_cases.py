"""Hard cases of both densifications: what is left must be finite, and as many as its optimizers know of."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hard_cases import Case, Family

from ssa_nerfstudio.plugin.compat.gsplat_repairs import repair_mcmc
from ssa_nerfstudio.plugin.training.densification import AdaptiveDensityControl, MarkovChainMonteCarlo

DENSIFICATION = Family("Densification")
Params = torch.nn.ParameterDict
Optimizers = dict[str, torch.optim.Optimizer]

repair_mcmc()


def gaussians(n: int) -> tuple[Params, Optimizers]:
    """Ordinary Gaussians, alive, with optimizers that have made a step; the same numbers on every device."""
    generator, device = torch.Generator("cpu").manual_seed(n), torch.get_default_device()
    shapes = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "features_dc": (n, 3), "opacities": (n, 1)}
    drawn = {k: 0.5 * torch.randn(s, generator=generator, device="cpu") for k, s in shapes.items()}
    params = Params({k: torch.nn.Parameter(value.to(device)) for k, value in drawn.items()})
    params["scales"].data -= 5
    params["opacities"].data.abs_()
    optimizers: Optimizers = {k: torch.optim.Adam([p], lr=1e-3, eps=1e-15) for k, p in params.items()}
    for name, p in params.items():
        p.grad = torch.ones_like(p)
        optimizers[name].step()
    return params, optimizers


def seen(n: int, gradient: float = 1e-2) -> dict[str, Any]:
    """What a rasterizer reports of a view that shows all."""
    means2d = torch.zeros(1, n, 2, requires_grad=True)
    means2d.grad = torch.full((1, n, 2), gradient)
    radii = torch.full((1, n), 3, dtype=torch.int32)
    return {"width": 40, "height": 30, "n_cameras": 1, "radii": radii, "gaussian_ids": None, "means2d": means2d}


def adc(params: Params, optimizers: Optimizers, gradient: float = 1e-2, steps: int = 3, **options) -> None:
    """Three refinements, then `whole`."""
    strategy = AdaptiveDensityControl(
        refine_start_iter=0, refine_every=1, reset_every=1000, pause_refine_after_reset=0, **options
    )
    state = strategy.initialize_state()
    for step in range(1, 1 + steps):
        strategy.step_post_backward(params, optimizers, state, step, seen(len(params["means"]), gradient))
        assert len(state["grad2d"]) == len(params["means"])
    whole(params, optimizers)


def mcmc(params: Params, optimizers: Optimizers, steps: int = 3, **options) -> None:
    """Three refinements, then `whole`."""
    strategy = MarkovChainMonteCarlo(refine_start_iter=0, refine_every=1, **options)
    state = strategy.initialize_state()
    for step in range(1, 1 + steps):
        strategy.step_post_backward(params, optimizers, state, step, {})
    whole(params, optimizers)


def whole(params: Params, optimizers: Optimizers) -> None:
    count = len(params["means"])
    assert count > 0
    for name, parameter in params.items():
        assert len(parameter) == count
        assert torch.isfinite(parameter).all(), name
        assert optimizers[name].param_groups[0]["params"] == [parameter]
        moments = optimizers[name].state[parameter]
        assert moments["exp_avg"].shape == parameter.shape
        assert torch.isfinite(moments["exp_avg_sq"]).all()
        parameter.grad = torch.ones_like(parameter)
        optimizers[name].step()
        assert torch.isfinite(parameter).all()


BOTH = {"ADC": adc, "MCMC": mcmc}


def both(name: str, wrong: str):
    """A case for each densification."""

    def add(check):
        for label, densify in BOTH.items():
            DENSIFICATION.case(f"{name} ({label})", wrong, densify)(check)
        return check

    return add


@both("all dead", "Relocation draws from nothing and fails; pruning leaves an empty scene that never grows again.")
def _(densify) -> None:
    params, optimizers = gaussians(30)
    params["opacities"].data.fill_(-9.0)
    densify(params, optimizers)
    assert len(params["means"]) >= 30


@both("all dead to the last bit", "Opacities of exactly 0 sum to 0, from which nothing can be drawn.")
def _(densify) -> None:
    params, optimizers = gaussians(30)
    params["opacities"].data.fill_(-200.0)
    densify(params, optimizers)


@both("all but one dead", "One Gaussian takes the place of hundreds, beyond the 51 that the formula is tabled for.")
def _(densify) -> None:
    params, optimizers = gaussians(400)
    params["opacities"].data[1:] = -9.0
    densify(params, optimizers)


@both("all alive", "Nothing to relocate or prune: empty selections.")
def _(densify) -> None:
    densify(*gaussians(30))


@both("all opaque", "A logit of an opacity of 1 is infinite, and 1 - (1 - o)^(1 / n) has no digits left.")
def _(densify) -> None:
    params, optimizers = gaussians(30)
    params["opacities"].data.fill_(40.0)
    densify(params, optimizers)


@both("all NaN but one", "A NaN opacity is neither dead nor alive, and weights with NaN cannot be drawn from.")
def _(densify) -> None:
    params, optimizers = gaussians(30)
    for parameter in params.values():
        parameter.data[1:] = math.nan
    densify(params, optimizers)


@both("one NaN mean among many", "It is never drawn, never pruned, and refused by the checkpoint.")
def _(densify) -> None:
    params, optimizers = gaussians(30)
    params["means"].data[7, 1] = math.nan
    densify(params, optimizers)


@both("one infinite scale", "It covers every frame, or none.")
def _(densify) -> None:
    params, optimizers = gaussians(30)
    params["scales"].data[7] = math.inf
    densify(params, optimizers)


@both("a single Gaussian", "Statistics of one, and neighbors of none.")
def _(densify) -> None:
    densify(*gaussians(1))


@DENSIFICATION.case("the cap reached", "More Gaussians than memory was promised for.")
def _() -> None:
    params, optimizers = gaussians(40)
    params["opacities"].data[:10] = -9.0
    mcmc(params, optimizers, cap_max=40)
    assert len(params["means"]) == 40


@DENSIFICATION.case("a cap below the start", "A negative number of Gaussians to add.")
def _() -> None:
    params, optimizers = gaussians(40)
    mcmc(params, optimizers, cap_max=10)
    assert len(params["means"]) == 40


@DENSIFICATION.case("nothing to split", "Gradients of 0: empty selections are concatenated.")
def _() -> None:
    params, optimizers = gaussians(40)
    adc(params, optimizers, gradient=0.0)
    assert len(params["means"]) == 40


@DENSIFICATION.case("everything to split", "Every Gaussian is replaced by two and every index moves.")
def _() -> None:
    params, optimizers = gaussians(20)
    params["scales"].data.fill_(0.0)
    adc(params, optimizers, steps=1, grow_scale3d=0.01, prune_scale3d=1e9)
    assert len(params["means"]) == 40


@DENSIFICATION.case("everything too large", "Every Gaussian is pruned for its size.")
def _() -> None:
    params, optimizers = gaussians(20)
    params["scales"].data.fill_(5.0)
    strategy = AdaptiveDensityControl(refine_start_iter=0, refine_every=1, reset_every=2, pause_refine_after_reset=0)
    state = strategy.initialize_state()
    for step in (3, 5):
        strategy.step_post_backward(params, optimizers, state, step, seen(len(params["means"]), 0.0))
    whole(params, optimizers)


@DENSIFICATION.case("a reset at the first step", "gsplat resets opacities at step 0, before anything was learned.")
def _() -> None:
    params, optimizers = gaussians(20)
    before = params["opacities"].detach().clone()
    strategy = AdaptiveDensityControl(reset_every=1)
    strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 0, seen(20))
    assert torch.equal(params["opacities"], before)


@DENSIFICATION.case("a reset at every step", "Moments that are reset to zero while steps go on.")
def _() -> None:
    params, optimizers = gaussians(20)
    strategy = AdaptiveDensityControl(refine_start_iter=0, refine_every=1, reset_every=1)
    state = strategy.initialize_state()
    for step in range(5):
        strategy.step_post_backward(params, optimizers, state, step, seen(len(params["means"]), 0.0))
    whole(params, optimizers)


@DENSIFICATION.case(
    "relocation of everything but one, again and again", "The one that lives is divided until nothing is left of it."
)
def _() -> None:
    params, optimizers = gaussians(60)
    for _ in range(30):
        with torch.no_grad():
            params["opacities"][1:] = -9.0
        mcmc(params, optimizers, steps=1, cap_max=60)
    assert (torch.sigmoid(params["opacities"]) > 0).all()


@DENSIFICATION.case("statistics of views that show nothing", "Means over no view: 0 / 0.")
def _() -> None:
    params, optimizers = gaussians(20)
    strategy = AdaptiveDensityControl(refine_start_iter=0, refine_every=1)
    state = strategy.initialize_state()
    view = seen(20)
    view["radii"].zero_()
    for step in (1, 2):
        strategy.step_post_backward(params, optimizers, state, step, view)
    assert len(params["means"]) == 20
    whole(params, optimizers)


@DENSIFICATION.case(
    "noise on Gaussians of 1e4", "The covariance of the largest allowed Gaussian is 1e8, times a random number."
)
def _() -> None:
    params, optimizers = gaussians(30)
    params["scales"].data.fill_(math.log(1e4))
    params["opacities"].data.fill_(-6.0)
    mcmc(params, optimizers, steps=1)


@DENSIFICATION.parametrize
def test_densification(case: Case) -> None:
    torch.manual_seed(0)
    case.check()


@pytest.mark.stability
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@DENSIFICATION.parametrize
def test_densification_on_cuda(case: Case) -> None:
    torch.manual_seed(0)
    with torch.device("cuda"):
        case.check()
