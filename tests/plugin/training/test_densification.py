"""ADC and MCMC: the same sums as gsplat's, on any device, and the equations of the papers."""

from __future__ import annotations

import math
from typing import Any

import gsplat.strategy.ops as ops
import numpy as np
import pytest
import torch
from conftest import check_in_tritons_interpreter
from gsplat.strategy import DefaultStrategy, MCMCStrategy
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.plugin.compat.gsplat_repairs import relocated, repair_mcmc
from ssa_nerfstudio.plugin.settings import ModelSettings
from ssa_nerfstudio.plugin.training.densification import AdaptiveDensityControl, MarkovChainMonteCarlo, make_strategy
from ssa_nerfstudio.plugin.training.gradient_statistics import GradientStatistics
from ssa_nerfstudio.plugin.training.langevin_noise import perturb

WIDTH, HEIGHT = 40, 30


@pytest.fixture(autouse=True, scope="module")
def mcmc_on_cpu() -> None:
    repair_mcmc()


def gaussians(n: int, seed: int = 0) -> tuple[torch.nn.ParameterDict, dict[str, torch.optim.Optimizer]]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "features_dc": (n, 3), "opacities": (n, 1)}
    params = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(0.5 * torch.randn(shape, generator=generator)) for name, shape in shapes.items()}
    )
    params["scales"].data -= 4
    optimizers: dict[str, torch.optim.Optimizer] = {name: torch.optim.Adam([p], lr=1e-3) for name, p in params.items()}
    for name, p in params.items():
        p.grad = torch.ones_like(p)
        optimizers[name].step()
    return params, optimizers


def rendered(n: int, seed: int, absgrad: bool) -> dict:
    """What a rasterizer reports after a backward pass, for one camera that sees some of the Gaussians."""
    generator = torch.Generator().manual_seed(seed)
    means2d = torch.zeros(1, n, 2, requires_grad=True)
    gradient = torch.randn(1, n, 2, generator=generator) * 1e-4
    if absgrad:
        means2d.absgrad = gradient.abs()  # pyright: ignore[reportAttributeAccessIssue]
    else:
        means2d.grad = gradient
    radii = torch.randint(0, 20, (1, n), generator=generator, dtype=torch.int32)
    radii[:, ::3] = 0
    sizes = {"width": WIDTH, "height": HEIGHT, "n_cameras": 1}
    return {**sizes, "radii": radii, "gaussian_ids": None, "means2d": means2d}


@pytest.mark.parametrize("absgrad", [False, True])
def test_the_statistics_are_gsplats(absgrad):
    options = {"absgrad": absgrad, "refine_scale2d_stop_iter": 4000}
    ours, theirs = AdaptiveDensityControl(**options), DefaultStrategy(**options)
    states = [strategy.initialize_state() for strategy in (ours, theirs)]
    params, _ = gaussians(50)
    for seed in range(4):
        for strategy, state in zip((ours, theirs), states, strict=True):
            strategy._update_state(params, state, rendered(50, seed, absgrad))
    for key in ("grad2d", "count", "radii"):
        torch.testing.assert_close(states[0][key], states[1][key], rtol=1e-6, atol=0)


STATISTICS = """
import torch
from ssa_nerfstudio.plugin.training import gradient_statistics as plain
from ssa_nerfstudio.plugin.training._gradient_statistics_triton import add_view

def views():
    generator = torch.Generator().manual_seed(0)
    for taken in (None, torch.tensor(1.0), torch.tensor(0.0), torch.tensor(1.0)):
        scales = 10.0 ** torch.randint(-30, 3, (700, 1), generator=generator)
        gradients = scales * torch.randn(700, 2, generator=generator)
        radii = torch.randint(-20, 30, (700,), generator=generator, dtype=torch.int32).clamp_min(0)
        gradients[0], radii[0] = 0.0, 7
        if taken is not None and not taken:
            gradients[5:9] = float("nan")
        elif taken is not None:
            gradients[11, 0], gradients[12, 1], gradients[13, 1] = float("nan"), float("nan"), float("inf")
            radii[11:14] = 5
        yield gradients, radii, taken

for sizes in (True, False):
    starts = [k * torch.rand(700, generator=torch.Generator().manual_seed(k)) for k in range(3)]
    sums, mine = ([each.clone() for each in starts] for _ in "ab")
    for gradients, radii, taken in views():
        largest = (sums[2], mine[2]) if sizes else (None, None)
        plain.GradientStatistics(*sums[:2], largest[0]).add(gradients, radii, 40, 30, 2, taken)
        add_view(*mine[:2], largest[1], gradients, radii, taken, 40.0, 30 / 40, 1 / 40)
    for name, a, b in zip(("gradients", "counts", "largest"), sums, mine, strict=True):
        say = f"{name}, sizes {sizes}: {{}}".format
        torch.testing.assert_close(b, a, rtol=1e-5, atol=0, equal_nan=True, msg=say)
    assert mine[0].isfinite().sum() == 697
print("equal")
"""


def test_tritons_statistics_are_the_plain_ones_in_its_interpreter():
    check_in_tritons_interpreter(STATISTICS)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("taken", [None, 0.0, 1.0])
def test_statistics_on_a_gpu_are_those_of_a_cpu(taken):
    generator = torch.Generator().manual_seed(0)
    gradients = torch.randn(5000, 2, generator=generator) * 1e-6
    radii = torch.randint(-20, 30, (5000,), generator=generator, dtype=torch.int32).clamp_min(0)
    found = []
    for device in ("cpu", "cuda"):
        sums = [torch.full((5000,), 0.1, device=device) for _ in range(3)]
        verdict = None if taken is None else torch.tensor(taken, device=device)
        GradientStatistics(*sums).add(gradients.to(device), radii.to(device), WIDTH, HEIGHT, 1, verdict)
        found.append([each.cpu() for each in sums])
    torch.testing.assert_close(*found, rtol=1e-5, atol=0)


def test_refinement_grows_and_prunes_as_gsplats_does():
    results = []
    for kind in (AdaptiveDensityControl, DefaultStrategy):
        strategy = kind(refine_start_iter=0, refine_every=2, reset_every=1000, grow_grad2d=1e-3)
        params, optimizers = gaussians(80)
        state = strategy.initialize_state()
        torch.manual_seed(1)
        for step in (1, 2):
            strategy.step_post_backward(params, optimizers, state, step, rendered(80, step, False))
        results.append(params)
    assert len(results[0]["means"]) > 80
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


@pytest.mark.parametrize(("step", "small", "left"), [(11, 1, 1), (11, 0, 5), (10, 1, 5)])
def test_what_is_too_large_is_removed_after_the_first_reset_unless_nothing_would_be_left(step, small, left):
    params, optimizers = gaussians(5)
    with torch.no_grad():
        params["opacities"].fill_(2.0)
        params["scales"].fill_(-4.0)
        params["scales"][small:, 1] = 0.0  # as long as the scene's extent
    strategy = AdaptiveDensityControl(reset_every=10)
    removed = strategy._prune_gs(params, optimizers, strategy.initialize_state(scene_scale=1.0), step)
    assert (removed, len(params["means"])) == (5 - left, left)


def test_opacities_are_not_reset_before_the_first_step():
    params, optimizers = gaussians(20)
    before = params["opacities"].detach().clone()
    strategy = AdaptiveDensityControl(reset_every=10)
    state = strategy.initialize_state()
    strategy.step_post_backward(params, optimizers, state, 0, rendered(20, 0, False))
    assert torch.equal(params["opacities"], before)
    strategy.step_post_backward(params, optimizers, state, 10, rendered(20, 0, False))
    assert torch.sigmoid(params["opacities"]).max() <= 2 * strategy.prune_opa + 1e-6


def equation_nine(o: float, s: float, n: int) -> tuple[float, float]:
    """3DGS as MCMC, equation 9, with Python's exact binomials and double precision, term by term."""
    new = 1 - (1 - o) ** (1 / n)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1) for i in range(1, n + 1) for k in range(i)
    )
    return new, o / total * s


@settings(max_examples=60, deadline=None)
@given(st.floats(0.01, 0.99), st.floats(1e-3, 10), st.integers(1, 20))
def test_relocation_is_equation_nine(o, s, n):
    binoms = MarkovChainMonteCarlo().initialize_state()["binoms"]
    opacity, scale = torch.tensor([o], dtype=torch.float64), torch.full((1, 3), s, dtype=torch.float64)
    new_opacity, new_scale = relocated(opacity, scale, torch.tensor([n]), binoms)
    expected_opacity, expected_scale = equation_nine(o, s, n)
    np.testing.assert_allclose(new_opacity.numpy(), expected_opacity, rtol=1e-9)
    np.testing.assert_allclose(new_scale.numpy(), expected_scale, rtol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_relocation_on_a_gpu_is_that_of_a_cpu_and_writes_no_table():
    binoms = MarkovChainMonteCarlo().initialize_state()["binoms"].cuda()
    opacities, scales = torch.rand(500).clamp(0.01, 0.99).cuda(), torch.rand(500, 3).cuda()
    counts = torch.randint(1, 60, (500,)).cuda()
    with torch.profiler.profile() as profiler:
        found = ops.compute_relocation(opacities, scales, counts, binoms)
    expected = relocated(opacities.cpu(), scales.cpu(), counts.cpu(), binoms.cpu())
    torch.testing.assert_close(found[0].cpu(), expected[0], rtol=1e-4, atol=1e-6)
    few = counts.cpu() <= 8  # of more, the sum's alternating terms cancel in the kernel's float32
    torch.testing.assert_close(found[1].cpu()[few], expected[1][few], rtol=1e-2, atol=1e-5)
    assert sum(each.count for each in profiler.key_averages() if each.key.startswith("aten::")) < 30


@pytest.mark.parametrize("n", [1, 2, 51, 400])
def test_relocation_keeps_the_opacity_of_the_whole_and_shrinks(n):
    binoms = MarkovChainMonteCarlo().initialize_state()["binoms"]
    opacities, scales = torch.linspace(0.02, 0.98, 25)[:, None], torch.ones(25, 3)
    new, sizes = relocated(opacities, scales, torch.full((25,), n), binoms)
    copies = min(n, 51)
    torch.testing.assert_close(1 - (1 - new) ** copies, opacities, rtol=1e-4, atol=1e-5)
    assert new.shape == opacities.shape
    assert torch.isfinite(sizes).all()
    assert (sizes <= 1.0 + 1e-5).all()
    assert (sizes > 0).all()


def test_mcmc_moves_the_dead_adds_up_to_its_cap_and_perturbs():
    params, optimizers = gaussians(60)
    params["opacities"].data[:20] = -9.0
    params["opacities"].data[20:30] = -3.5  # alive, and transparent enough for the noise to move them
    strategy = MarkovChainMonteCarlo(refine_start_iter=0, refine_every=1, cap_max=62)
    state = strategy.initialize_state(scene_scale=1.0)
    before = params["means"].detach().clone()
    strategy.step_post_backward(params, optimizers, state, 1, {})
    assert len(params["means"]) == 62
    assert (torch.sigmoid(params["opacities"]) > strategy.min_opacity).all()
    assert (params["means"][20:30] != before[20:30]).any(dim=1).all()
    assert all(torch.isfinite(p).all() for p in params.values())
    assert all(optimizers[name].state[params[name]]["exp_avg"].shape == params[name].shape for name in params)


def test_mcmc_keeps_the_allocators_memory_where_it_adds_nothing(monkeypatch):
    """Relocation takes place where the Gaussians are."""
    emptied = []
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: emptied.append(len(params["means"])))
    params, optimizers = gaussians(60)
    strategy = MarkovChainMonteCarlo(refine_start_iter=0, refine_every=1, cap_max=65)
    state = strategy.initialize_state()
    places = []
    for step in range(1, 6):
        params["opacities"].data[:5] = -9.0
        strategy.step_post_backward(params, optimizers, state, step, {})
        places.append([parameter.data_ptr() for parameter in params.values()])
    assert emptied == [63, 65]
    assert places[1] == places[-1]


def test_mcmc_relocates_adds_and_perturbs_as_gsplats_does():
    results = []
    for kind in (MarkovChainMonteCarlo, MCMCStrategy):
        strategy = kind(refine_start_iter=0, refine_every=2, refine_stop_iter=6, cap_max=70)
        params, optimizers = gaussians(60)
        params["opacities"].data[:20] = -9.0
        state = strategy.initialize_state()
        torch.manual_seed(1)
        options: Any = {} if kind is MarkovChainMonteCarlo else {"lr": 1e-3}
        for step in range(8):
            strategy.step_post_backward(params, optimizers, state, step, {}, **options)
        results.append(params)
    assert len(results[0]["means"]) > 60
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


INTERPRETED = """
import torch
from ssa_nerfstudio.plugin.compat.gsplat_repairs import repair_mcmc
repair_mcmc()
from gsplat.strategy.ops import inject_noise_to_position
from ssa_nerfstudio.plugin.training._langevin_noise_triton import perturb_means

torch.manual_seed(0)
for n in (1, 700):
    params = {
        "means": torch.randn(n, 3), "quats": torch.randn(n, 4),
        "scales": torch.randn(n, 3) - 2, "opacities": 3 * torch.randn(n, 1) - 4,
    }
    params["quats"][0] = 0
    expected = {name: p.clone() for name, p in params.items()}
    torch.manual_seed(1)
    inject_noise_to_position(expected, {}, {}, 5.0)
    torch.manual_seed(1)
    normals = torch.randn(n, 3)
    rest = [params[name] for name in ("quats", "scales", "opacities")]
    for scale in (None, torch.ones(())):
        means = params["means"].clone()
        perturb_means(means, *rest, normals, 5.0, scale)
        torch.testing.assert_close(means, expected["means"], rtol=1e-5, atol=1e-5)
    means = params["means"].clone()
    perturb_means(means, *rest, torch.full_like(normals, torch.nan), 5.0, torch.zeros(()))
    assert torch.equal(means, params["means"])
print("equal")
"""


def test_tritons_noise_is_gsplats_in_its_interpreter():
    check_in_tritons_interpreter(INTERPRETED)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("scale", [None, 0.0, 1.0])
def test_noise_on_a_gpu_is_gsplats(scale):
    params, _ = gaussians(5000)
    params["opacities"].data -= 4
    params["scales"].data += 2
    params = {name: p.data.cuda() for name, p in params.items()}
    expected = {name: p.clone() for name, p in params.items()}
    if scale != 0.0:
        torch.manual_seed(1)
        ops.inject_noise_to_position(expected, {}, {}, 5.0)  # pyright: ignore[reportArgumentType]
    torch.manual_seed(1)
    perturb(params, 5.0, None if scale is None else torch.tensor(scale, device="cuda"))
    torch.testing.assert_close(params["means"], expected["means"], rtol=1e-5, atol=1e-5)


def test_the_noise_follows_the_learning_rate_of_the_means():
    moved = []
    for lr in (0.0, 1e-3):
        params, optimizers = gaussians(30)
        params["opacities"].data[:] = -6.0
        optimizers["means"].param_groups[0]["lr"] = lr
        before = params["means"].detach().clone()
        strategy = MarkovChainMonteCarlo(refine_start_iter=100)
        strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, {})
        moved.append((params["means"] - before).abs().max().item())
    assert moved[0] == 0
    assert moved[1] > 0


def test_covariances_on_a_cpu_are_rotated_squared_scales():
    quats, scales = torch.tensor([[math.sqrt(0.5), 0, 0, math.sqrt(0.5)]]), torch.tensor([[1.0, 2.0, 3.0]])
    covars, _ = ops.quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    assert covars is not None
    torch.testing.assert_close(covars[0], torch.diag(torch.tensor([4.0, 1.0, 9.0])), atol=1e-5, rtol=0)


@pytest.mark.parametrize("opacity", [-9.0, float("nan")])
@pytest.mark.parametrize("guarded", [True, False])
def test_relocation_with_nobody_alive_or_with_nan_fails_without_the_guard(opacity, guarded):
    params, optimizers = gaussians(30)
    params["opacities"].data[:] = -9.0
    params["opacities"].data[1:] = opacity
    strategy = MarkovChainMonteCarlo(refine_start_iter=0, refine_every=1, guarded=guarded)
    if guarded:
        strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, {})
        assert all(torch.isfinite(p).all() for p in params.values())
        assert (torch.sigmoid(params["opacities"]) > strategy.min_opacity).any()
    else:
        with pytest.raises(RuntimeError):
            strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, {})


@pytest.mark.parametrize("guarded", [True, False])
def test_pruning_leaves_a_scene_only_with_the_guard(guarded):
    params, optimizers = gaussians(30)
    params["opacities"].data[:] = -9.0
    strategy = AdaptiveDensityControl(
        refine_start_iter=0, refine_every=1, pause_refine_after_reset=0, guarded=guarded, grow_grad2d=1e9
    )
    strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, rendered(30, 0, False))
    assert len(params["means"]) == (30 if guarded else 0)


def test_noise_is_left_out_of_a_skipped_step():
    moved = []
    for taken in (1.0, 0.0):
        params, optimizers = gaussians(30)
        params["opacities"].data[:] = -6.0
        before = params["means"].detach().clone()
        strategy = MarkovChainMonteCarlo(refine_start_iter=100)
        info = {"taken": torch.tensor(taken)}
        strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, info)
        moved.append((params["means"] - before).abs().max().item())
    assert moved[0] > 0
    assert moved[1] == 0


def test_mcmc_starts_from_small_half_transparent_gaussians_and_follows_the_settings():
    params, _ = gaussians(30)
    sizes = torch.exp(params["scales"].detach()).clone()
    settings = ModelSettings(
        strategy="mcmc", mcmc_scale_start=0.25, mcmc_opacity_start=0.4, cap_max=77, warmup_length=11,
        mcmc_stop_at=222, refine_every=13, guards=False,
    )  # fmt: skip
    strategy = make_strategy(settings, {}, params)
    assert isinstance(strategy, MarkovChainMonteCarlo)
    torch.testing.assert_close(torch.exp(params["scales"].detach()), 0.25 * sizes)
    torch.testing.assert_close(torch.sigmoid(params["opacities"].detach()), torch.full((30, 1), 0.4))
    found = (strategy.cap_max, strategy.refine_start_iter, strategy.refine_stop_iter, strategy.refine_every)
    assert found == (77, 11, 222, 13)
    assert not strategy.guarded


@pytest.mark.parametrize(("pause", "expected"), [(None, 55), (9, 9), (0, 0)])
def test_adc_starts_from_the_gaussians_as_they_are_with_splatfactos_fields(pause, expected):
    params, _ = gaussians(30)
    before = {name: value.detach().clone() for name, value in params.items()}
    fields = {"refine_every": 17, "verbose": True, "pause_refine_after_reset": 55}
    strategy = make_strategy(ModelSettings(strategy="adc", pause_after_reset=pause, guards=False), fields, params)
    assert isinstance(strategy, AdaptiveDensityControl)
    assert all(torch.equal(params[name], value) for name, value in before.items())
    found = (strategy.refine_every, strategy.verbose, strategy.guarded, strategy.pause_refine_after_reset)
    assert found == (17, False, False, expected)
