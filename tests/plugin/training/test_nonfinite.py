"""Decisions about values that are not finite, with the overlay on and off, and what happens without them."""

from __future__ import annotations

import copy
import itertools
import math
from collections import Counter

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from ssa_nerfstudio.errors import TrainingError
from ssa_nerfstudio.overlay.layer import MATTE_LOGIT_RANGE, ScreenSpaceOverlay
from ssa_nerfstudio.plugin.trainer import SSATrainer
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdam
from ssa_nerfstudio.plugin.training.gradient_statistics import GradientStatistics
from ssa_nerfstudio.plugin.training.nonfinite import (
    CLAMP_EVERY,
    SCALE_RANGE,
    SQUARE_LIMIT,
    NonFiniteGuard,
    clamp_scales,
    finite_points,
    first_nonfinite,
    mark_for_removal,
    replace_nonfinite_scales,
)
from ssa_nerfstudio.plugin.training.optimizers import JointOptimizers

OF_THE_TRAINER = ("use_grad_scaler", "gradient_accumulation_steps", "log_gradients")
OVERLAYS = pytest.mark.parametrize("overlay", ["on", "off"])


@pytest.fixture(scope="session")
def make(configure_training):
    def make(data, output, steps: int = 4, method: str = "ssa-splatfacto", **settings) -> SSATrainer:
        """A trainer that has been set up and has not begun; settings of the trainer and of the model."""
        torch.manual_seed(0)
        own = {name: settings.pop(name) for name in OF_THE_TRAINER if name in settings}
        config = configure_training(method, data, output, steps, {"num_downscales": 0, **settings})
        for name, value in own.items():
            setattr(config, name, value)
        config.scale_schedules = False  # of a few steps, the densification's statistics would end at once
        config.set_timestamp()
        config.viewer.quit_on_train_completion = True
        trainer: SSATrainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer

    return make


def spoil(trainer: SSATrainer, steps: set[int] | range, what: str = "scales", value: float = math.nan) -> None:
    """Let the gradient of one parameter (or "loss": the loss alone) be `value` at some steps."""
    pipeline, optimizers = trainer.pipeline, trainer.optimizers
    get_losses, step_groups = pipeline.get_train_loss_dict, optimizers.step_groups
    steps_begun: list[int] = []

    def get_train_loss_dict(step: int):
        steps_begun.append(step)
        outputs, losses, metrics = get_losses(step)
        if step in steps and what == "loss":
            # A loss that is not finite without a gradient that is not: only the loss tells.
            losses["broken"] = losses["main_loss"].new_tensor(value)
        return outputs, losses, metrics

    def step_spoiled(groups, loss, grad_scaler) -> None:
        if steps_begun[-1] in steps and what != "loss":
            # Not by a hook of autograd's, which knows nothing of gradients that are taken by hand.
            gradient = pipeline.get_param_groups()[what][0].grad
            assert gradient is not None
            gradient.view(-1)[0] += value
        step_groups(groups, loss, grad_scaler)

    pipeline.get_train_loss_dict, optimizers.step_groups = get_train_loss_dict, step_spoiled


def state(trainer: SSATrainer) -> dict[str, Tensor]:
    """Every parameter, every moment and step of Adam, and the densification's sums, copied."""
    found = {name: value for name, value in trainer.pipeline.state_dict().items() if isinstance(value, Tensor)}
    for group, optimizer in trainer.optimizers.optimizers.items():
        for k, moments in optimizer.state_dict()["state"].items():
            found |= {f"{group}.{k}.{name}": value for name, value in moments.items()}
    found |= {name: v for name, v in trainer.pipeline.model.strategy_state.items() if isinstance(v, Tensor)}
    return copy.deepcopy(found)


def after_each_step(trainer: SSATrainer) -> list[dict[str, Tensor]]:
    states: list[dict[str, Tensor]] = []
    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks.append(TrainingCallback(location, lambda step: states.append(state(trainer))))
    return states


@pytest.mark.parametrize(
    ("overlay", "what"),
    [("on", "overlay"), *itertools.product(["on", "off"], ["scales", "means", "loss"])],
)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_step_that_is_not_finite_leaves_everything_as_it_was(tiny_scene, tmp_path, overlay, what, value, make):
    trainer = make(tiny_scene, tmp_path, overlay=overlay)
    spoil(trainer, {2}, what, value)
    states = after_each_step(trainer)
    trainer.train()
    before, after = states[1], states[2]
    assert before.keys() == after.keys()
    assert changed(before, after) == set()
    assert {"_model.gauss_params.means", "means.0.exp_avg", "means.0.step", "grad2d", "count"} <= changed(
        after, states[3]
    )
    assert first_nonfinite(states[3]) is None


def changed(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    """What differs."""
    return {name for name in before if not torch.equal(before[name], after[name])}


def train_step(trainer: SSATrainer, step: int) -> dict:
    """One step with its callbacks, as nerfstudio's loop takes it; what it logs."""
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    _, _, metrics = trainer.train_iteration(step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
    return metrics


class Operations(TorchDispatchMode):
    """Counts what torch does."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_dispatch__(self, operation, types, arguments=(), settings=None):
        self.counts[operation.overloadpacket.__name__] += 1
        return operation(*arguments, **(settings or {}))


@OVERLAYS
@pytest.mark.parametrize("method", ["ssa-splatfacto", "ssa-splatfacto-mcmc"])
def test_the_guard_never_waits_for_the_device_and_does_little(tiny_scene, tmp_path, overlay, method, make, monkeypatch):
    """Between two checks: reading one number (`_local_scalar_dense`) would make the host wait at every step."""
    monkeypatch.setenv("SSA_CUDA_GRAPHS", "0")  # what a recording launches cannot be counted
    counts: dict[bool, Counter[str]] = {}
    for guards in (True, False):
        trainer = make(tiny_scene, tmp_path / str(guards), steps=8, method=method, overlay=overlay, guards=guards)
        trainer.pipeline.train()
        for step in range(3):
            with Operations() as operations:
                train_step(trainer, step)
        counts[guards] = operations.counts
    more = counts[True] - counts[False]
    assert more["_local_scalar_dense"] == 0
    assert more["item"] == 0
    launched = more.total() - more["view"] - more["detach"] - more["alias"]
    fewer = counts[False] - counts[True]
    # Two searches, the verdict's complement, and masked radii; MCMC's noise is scaled.
    assert launched - fewer.total() <= (5 if "mcmc" in method else 4)


@OVERLAYS
def test_without_the_guard_such_a_step_spoils_the_parameters(tiny_scene, tmp_path, overlay, make):
    trainer = make(tiny_scene, tmp_path, overlay=overlay, guards=False)
    spoil(trainer, {2})
    states = after_each_step(trainer)
    with pytest.raises(TrainingError, match="holds values that are not finite"):
        trainer.train()
    assert first_nonfinite(states[1]) is None
    assert not torch.isfinite(states[2]["_model.gauss_params.scales"]).all()


@OVERLAYS
def test_the_statistics_of_a_broken_step_are_left_out_and_spoilt_without_the_guard(
    tiny_scene, tmp_path, overlay, make, monkeypatch
):
    monkeypatch.setenv("SSA_CUDA_GRAPHS", "0")  # a recording draws the clean render itself
    sums = {}
    for guards in (True, False):
        trainer = make(tiny_scene, tmp_path / str(guards), guards=guards, overlay=overlay)
        spoil(trainer, {2}, "loss", math.nan)
        original = trainer.pipeline.model._render

        def render(*args, trainer=trainer, original=original):
            drawn = original(*args)
            if trainer.step == 2:
                drawn["rgb"] = drawn["rgb"] * math.nan
            return drawn

        setattr(trainer.pipeline.model, "_render", render)  # noqa: B010
        states = after_each_step(trainer)
        if guards:
            trainer.train()
        else:
            with pytest.raises(TrainingError):
                trainer.train()
        sums[guards] = states
    assert torch.equal(sums[True][1]["grad2d"], sums[True][2]["grad2d"])
    assert not torch.isfinite(sums[False][2]["grad2d"]).all()


def adam(parameter: torch.nn.Parameter) -> FusedAdam:
    return FusedAdam([parameter], lr=0.1, eps=1e-15)


LOSS = torch.ones(())


def test_a_gradient_whose_square_overflows_is_skipped_because_it_would_freeze_or_break_its_element():
    parameter, frozen = (torch.nn.Parameter(torch.zeros(3)) for _ in range(2))
    optimizer, plain = adam(parameter), torch.optim.Adam([frozen], lr=0.1, fused=True, eps=1e-15)
    guard = NonFiniteGuard(max_skipped_steps=10)
    for largest in (1e22, 1.0, 1.0):
        gradient = torch.tensor([largest, 1.0, 1.0])
        parameter.grad, frozen.grad = gradient.clone(), gradient.clone()
        optimizer.found_inf = guard.judge(LOSS, {"p": optimizer}).skipped  # pyright: ignore[reportAttributeAccessIssue]
        optimizer.step()
        plain.step()
    torch.testing.assert_close(parameter.detach(), torch.full((3,), -0.2))
    assert abs(frozen.detach()[0]) < 0.11
    assert torch.isinf(plain.state[frozen]["exp_avg_sq"][0])


@pytest.mark.parametrize("largest", [1.8e19, math.nextafter(2.0**64, 0), 2.0**64, 1.85e19])
def test_a_step_is_skipped_exactly_where_a_square_overflows_and_gradients_keep_their_size(largest, caplog):
    parameter = torch.nn.Parameter(torch.zeros(3))
    guard = NonFiniteGuard(max_skipped_steps=10)
    gradient = torch.tensor([-largest, 1.0, 1e-42])  # the last one is subnormal
    overflows = bool(torch.isinf(gradient.square()).any())
    parameter.grad = gradient.clone()
    verdict = guard.judge(LOSS, {"p": adam(parameter)})
    assert (verdict.taken, verdict.skipped) == (not overflows, overflows)
    assert torch.equal(parameter.grad[overflows:], gradient[overflows:])
    guard.check(0)
    assert ("the gradient of p was not finite" in caplog.text) == overflows


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38])
def test_a_loss_that_is_not_finite_is_skipped_although_its_gradients_are(value):
    parameter = torch.nn.Parameter(torch.tensor(1.0))
    parameter.grad = torch.ones(())
    verdict = NonFiniteGuard(max_skipped_steps=10).judge(torch.tensor(value), {"p": adam(parameter)})
    assert verdict.skipped == (not abs(value) < SQUARE_LIMIT)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", [0, 1, 2])
def test_one_value_among_many_parameters_is_found(value, where):
    parameters = [torch.nn.Parameter(torch.zeros(shape)) for shape in ((5, 3), (5,), (5, 15, 3))]
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    broken = parameters[where].grad
    assert broken is not None
    broken.view(-1)[-1] = value
    optimizers = {str(number): adam(parameter) for number, parameter in enumerate(parameters)}
    assert NonFiniteGuard(max_skipped_steps=10).judge(LOSS, optimizers).skipped == 1


def test_a_skipped_step_is_masked_out_of_the_densification():
    parameter = torch.nn.Parameter(torch.zeros(3))
    guard = NonFiniteGuard(max_skipped_steps=10)
    for value, taken in ((1.0, 1), (math.nan, 0)):
        parameter.grad = torch.full((3,), value)
        guard.judge(LOSS, {"p": adam(parameter)})
        info = {"radii": torch.tensor([[3, 0, 7]], dtype=torch.int32)}
        guard.tell_densification(info)
        assert info["taken"] == taken
        statistics = GradientStatistics(torch.ones(3), torch.zeros(3), torch.zeros(3))
        statistics.add(torch.full((3, 2), value), info["radii"][0], 10, 10, 1, info["taken"])
        assert statistics.counts.tolist() == [taken, 0, taken]
        assert (statistics.gradients > 1).tolist() == [taken == 1, False, taken == 1]
        assert statistics.largest is not None
        torch.testing.assert_close(statistics.largest, taken * torch.tensor([0.3, 0.0, 0.7]))


@pytest.mark.skipif(torch.cuda.is_available(), reason="gsplat adds gradients up in any order")
@OVERLAYS
@pytest.mark.parametrize("method", ["ssa-splatfacto", "ssa-splatfacto-mcmc"])
def test_a_sound_training_is_the_same_to_the_last_bit_without_guards(tiny_scene, tmp_path, overlay, method, make):
    states = {}
    for guards in (True, False):
        trainer = make(tiny_scene, tmp_path / str(guards), method=method, overlay=overlay, guards=guards)
        states[guards] = after_each_step(trainer)
        trainer.train()
    assert changed(states[True][-1], states[False][-1]) == set()
    assert changed(states[True][0], states[True][-1])


@pytest.mark.parametrize("kind", ["ours", "fused", "foreach", "single", "sgd"])
@pytest.mark.parametrize("scaled", [False, True])
def test_any_optimizer_skips_and_then_continues(kind, scaled):
    """Also where what is not finite belongs to another optimizer."""
    parameter, other = torch.nn.Parameter(torch.ones(4)), torch.nn.Parameter(torch.zeros(1))
    make_optimizer = {
        "ours": adam,
        "fused": lambda p: torch.optim.Adam([p], lr=0.1, fused=True),
        "foreach": lambda p: torch.optim.Adam([p], lr=0.1, foreach=True),
        "single": lambda p: torch.optim.Adam([p], lr=0.1, foreach=False),
        "sgd": lambda p: torch.optim.SGD([p], lr=0.1, momentum=0.9),
    }[kind]
    config = {name: {"optimizer": AdamOptimizerConfig(lr=0.1), "scheduler": None} for name in ("p", "other")}
    joint = JointOptimizers(config, {"p": [parameter], "other": [other]}, NonFiniteGuard(max_skipped_steps=10))
    joint.optimizers = {"p": make_optimizer(parameter), "other": torch.optim.SGD([other], lr=0.1)}
    grad_scaler = torch.amp.GradScaler("cpu", enabled=scaled, init_scale=4.0, growth_interval=1000)
    seen = []
    for value in (1.0, math.nan, 1.0):
        scale = float(grad_scaler.scale(torch.ones(())))
        parameter.grad, other.grad = torch.full((4,), scale), torch.full((1,), value * scale)
        joint.step_groups(["p", "other"], LOSS, grad_scaler)
        assert torch.equal(parameter.grad, torch.ones(4)), "gradients have their true size after the step"
        grad_scaler.update()
        seen.append(parameter.detach().clone())
    assert torch.equal(seen[0], seen[1])
    assert (seen[2] < seen[1]).all()
    assert torch.isfinite(other).all()


@pytest.mark.parametrize("asked", [True, False])
def test_a_training_with_a_gradient_scaler_is_guarded(tiny_scene, tmp_path, asked, make):
    trainer = make(tiny_scene, tmp_path, use_grad_scaler=asked)
    assert trainer.grad_scaler.is_enabled() == (asked and torch.cuda.is_available())
    spoil(trainer, {2})
    states = after_each_step(trainer)
    trainer.train()
    assert changed(states[1], states[2]) == set()
    assert first_nonfinite(states[3]) is None


def test_gradients_have_their_true_size_after_every_step(tiny_scene, tmp_path, make):
    """Of a training with and without the guard: hooks, logs and callbacks see the same gradients."""
    gradients = {}
    for guards in (True, False):
        trainer = make(tiny_scene, tmp_path / str(guards), steps=1, guards=guards, log_gradients=True)
        trainer.pipeline.train()
        metrics = train_step(trainer, 0)
        gradients[guards] = {
            name: p.grad for name, p in trainer.pipeline.model.named_parameters() if p.grad is not None
        }
        assert metrics["Gradients/gauss_params.means"] == gradients[guards]["gauss_params.means"].norm()
    for name, gradient in gradients[True].items():
        torch.testing.assert_close(gradient, gradients[False][name])


@OVERLAYS
@pytest.mark.parametrize("what", ["quats", "means", "loss", "large"])
def test_where_gradients_accumulate_a_broken_step_is_skipped_by_all_groups(tiny_scene, tmp_path, overlay, what, make):
    """Quaternions step every second time; at step 2 they only accumulate."""
    trainer = make(tiny_scene, tmp_path, overlay=overlay, gradient_accumulation_steps={"quats": 2})
    spoil(trainer, {2}, "quats" if what == "large" else what, 1e25 if what == "large" else math.nan)
    states = after_each_step(trainer)
    trainer.train()
    assert changed(states[1], states[2]) == set()
    assert {"_model.gauss_params.quats", "_model.gauss_params.means"} <= changed(states[0], states[1])
    assert first_nonfinite(states[3]) is None


def test_a_training_in_which_nothing_steps_at_first_is_guarded_as_well(tiny_scene, tmp_path, make):
    every = dict.fromkeys(("means", "scales", "quats", "features_dc", "features_rest", "opacities", "overlay"), 2)
    states = {}
    for guards in (True, False):
        trainer = make(tiny_scene, tmp_path / str(guards), guards=guards, gradient_accumulation_steps=every)
        states[guards] = after_each_step(trainer)
        trainer.train()
    assert "_model.gauss_params.means" not in changed(states[True][1], states[True][2])
    if not torch.cuda.is_available():  # gsplat adds gradients up in any order
        assert changed(states[True][-1], states[False][-1]) == set()


@pytest.mark.parametrize("method", ["ssa-splatfacto", "ssa-splatfacto-mcmc"])
def test_counts_are_right_after_a_window_of_skips_and_refinements(tiny_scene, tmp_path, method, make):
    settings = {"refine_every": 10, "warmup_length": 5, "stop_split_at": 100, "mcmc_stop_at": 100}
    trainer = make(tiny_scene, tmp_path, steps=100, method=method, max_skipped_steps=10, **settings)
    broken = {0, 3, 4, 10, 11, 19, 20, 21, 50, 55, 97, 99}
    spoil(trainer, broken, "scales")
    trainer.train()
    steps = {float(v["step"]) for o in trainer.optimizers.optimizers.values() for v in o.state.values()}
    assert steps == {100 - len(broken)}


def test_a_checkpoint_between_two_checks_holds_the_steps_that_were_taken(tiny_scene, tmp_path, make):
    trainer = make(tiny_scene, tmp_path, steps=12)
    trainer.config.steps_per_save, trainer.config.save_only_latest_checkpoint = 7, False
    spoil(trainer, {3, 5, 10}, "scales")
    trainer.train()
    counts = {}
    for path in trainer.checkpoint_dir.iterdir():
        saved = torch.load(path, weights_only=False)
        counts[saved["step"]] = {float(v["step"]) for o in saved["optimizers"].values() for v in o["state"].values()}
    assert counts == {7: {6}, 11: {9}}


def test_optimizers_that_are_not_fused_skip_in_a_training_too(tiny_scene, tmp_path, configure_training):
    torch.manual_seed(0)
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 4, {"num_downscales": 0})
    for entry in config.optimizers.values():
        entry["optimizer"] = AdamOptimizerConfig(lr=entry["optimizer"].lr, eps=1e-15)
    config.set_timestamp()
    config.viewer.quit_on_train_completion = True
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    spoil(trainer, {2})
    states = after_each_step(trainer)
    trainer.train()
    assert changed(states[1], states[2]) == set()


@pytest.mark.parametrize("group", ["camera_opt", "bilateral_grid"])
def test_cameras_and_bilateral_grids_skip_with_the_rest(tiny_scene, tmp_path, group, make):
    from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig

    trainer = make(tiny_scene, tmp_path, camera_optimizer=CameraOptimizerConfig(mode="SO3xR3"), use_bilateral_grid=True)
    spoil(trainer, {2}, group)
    states = after_each_step(trainer)
    trainer.train()
    assert changed(states[1], states[2]) == set()


@OVERLAYS
def test_training_stops_after_so_many_in_a_row_and_names_parameter_and_step(tiny_scene, tmp_path, overlay, make):
    trainer = make(tiny_scene, tmp_path, steps=110, overlay=overlay, max_skipped_steps=20, stop_split_at=1)
    spoil(trainer, range(40, 110), "opacities")
    with pytest.raises(TrainingError) as caught:
        trainer.train()
    assert trainer.step == 99, "the host checks every 100 steps"
    line = str(caught.value)
    assert "stopped at step 99: 20 steps in a row, from step 40 on" in line
    assert "the gradient of opacities was not finite" in line


def test_skipped_steps_that_are_not_in_a_row_are_reported(tiny_scene, tmp_path, caplog, make):
    trainer = make(tiny_scene, tmp_path, steps=200, max_skipped_steps=3, stop_split_at=1)
    spoil(trainer, set(range(0, 200, 3)) | set(range(2, 200, 3)), "quats")
    trainer.train()
    told = caplog.text
    assert "skipped 67 of 100 steps up to 99: the gradient of quats was not finite" in told
    # The 200th was taken, and left no trace of what was wrong with those before.
    assert "skipped 66 of 100 steps up to 199: the loss or a gradient was not finite" in told


def test_if_all_breaks_all_is_named():
    guard = NonFiniteGuard(max_skipped_steps=1)
    parameters = [torch.nn.Parameter(torch.ones(2)) for _ in range(3)]
    optimizers = {name: torch.optim.SGD([p], lr=1.0) for name, p in zip("abc", parameters, strict=True)}
    for parameter in parameters[:2]:  # the third has none
        parameter.grad = torch.full((2,), math.inf)
    guard.judge(LOSS, optimizers)
    with pytest.raises(TrainingError, match="because every gradient was not finite"):
        guard.check(0)


def test_if_the_loss_breaks_it_alone_is_named():
    guard = NonFiniteGuard(max_skipped_steps=1)
    parameters = [torch.nn.Parameter(torch.ones(2)) for _ in range(2)]
    loss = (parameters[0] + parameters[1]).sum() * math.inf
    loss.backward()
    guard.judge(loss, {name: torch.optim.SGD([p], lr=1.0) for name, p in zip("ab", parameters, strict=True)})
    with pytest.raises(TrainingError, match="because the loss was not finite"):
        guard.check(0)


def test_a_row_of_skipped_steps_is_counted_across_checks():
    guard = NonFiniteGuard(max_skipped_steps=30)
    parameter = torch.nn.Parameter(torch.ones(2))
    optimizers: dict[str, torch.optim.Optimizer] = {"p": torch.optim.SGD([parameter], lr=1.0)}
    for step in range(200):
        parameter.grad = torch.full((2,), math.inf if 85 <= step < 115 else 1.0)
        guard.judge(LOSS, optimizers)
        if step == 99:
            assert guard.check(step) == 15
    with pytest.raises(TrainingError, match="from step 85 on"):
        guard.check(199)


def test_the_culprit_is_the_parameter_whose_value_broke():
    guard = NonFiniteGuard(max_skipped_steps=1)
    broken, fine = (torch.nn.Parameter(torch.ones(2)) for _ in range(2))
    broken.data[0] = math.nan
    for parameter in (broken, fine):
        parameter.grad = torch.full((2,), math.nan)
    optimizers = {name: torch.optim.SGD([p], lr=1.0) for name, p in (("b", broken), ("f", fine))}
    guard.judge(LOSS, optimizers)
    with pytest.raises(TrainingError, match=r"b \(the values themselves\)"):
        guard.check(0)


@OVERLAYS
@pytest.mark.parametrize("guards", [True, False])
def test_log_scales_stay_in_range(tiny_scene, tmp_path, overlay, guards, make):
    trainer = make(tiny_scene, tmp_path, steps=CLAMP_EVERY + 1, overlay=overlay, guards=guards)
    with torch.no_grad():
        trainer.pipeline.model.scales[0], trainer.pipeline.model.scales[1] = -40.0, 30.0
    trainer.train()
    scales = trainer.pipeline.model.scales.detach()[:2]
    assert (scales.min() >= math.log(SCALE_RANGE[0]) - 1e-4) == guards
    assert (scales.max() <= math.log(SCALE_RANGE[1]) + 1e-4) == guards


def test_the_largest_scale_in_range_still_has_a_determinant_in_float32():
    focal, near, largest = 1000.0, 0.01, torch.tensor(SCALE_RANGE[1])
    variance = (focal / near * largest) ** 2
    assert torch.isfinite(variance * variance)
    log_scales = torch.tensor([[-100.0, 0.0, 100.0]])
    clamp_scales(log_scales)
    torch.testing.assert_close(log_scales.exp(), torch.tensor([[SCALE_RANGE[0], 1.0, SCALE_RANGE[1]]]))


def press(guarded: bool, steps: int, sign: float) -> ScreenSpaceOverlay:
    """An overlay after so many long Adam steps on one gradient of its logits."""
    overlay = ScreenSpaceOverlay(2, 2)
    optimizer = torch.optim.Adam(overlay.parameters(), lr=0.05, eps=1e-15, fused=True)
    for _ in range(steps):
        for parameter in overlay.parameters():
            parameter.grad = torch.full_like(parameter, sign * 1e-6)
        optimizer.step()
        if guarded:
            overlay.clamp_logits()
    return overlay


@pytest.mark.parametrize("guarded", [True, False])
def test_the_matte_is_capped_so_that_the_scene_behind_keeps_a_gradient(guarded):
    overlay = press(guarded, 600, -1.0)
    clean = torch.rand(2, 2, 3, requires_grad=True)
    transmittance, addition = overlay.layers()
    (transmittance * clean + addition).sum().backward()
    assert clean.grad is not None
    assert (clean.grad.min() > 0.0009) == guarded
    assert overlay.matte().max() < 0.9991 or not guarded
    # In a file of 8 bits it is opaque.
    assert round(float(overlay.matte().max()) * 255) == 255


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_matte_at_either_end_comes_back_and_without_the_range_it_does_not(sign):
    back = {}
    for guarded in (True, False):
        overlay = press(guarded, 4000, sign)
        optimizer = torch.optim.Adam(overlay.parameters(), lr=0.05, eps=1e-15, fused=True)
        for _ in range(400):
            optimizer.zero_grad()
            (-sign * overlay.matte().mean() * 1e-6).backward()
            optimizer.step()
        back[guarded] = float(overlay.matte().mean())
    wanted = 1.0 if sign > 0 else 0.0
    assert abs(back[True] - wanted) < 0.1
    assert abs(back[False] - wanted) > 0.9


@OVERLAYS
@pytest.mark.parametrize("guards", [True, False])
def test_the_cap_holds_in_a_training_and_a_given_overlay_has_none(tiny_scene, tmp_path, overlay, guards, make):
    trainer = make(tiny_scene, tmp_path, steps=CLAMP_EVERY + 1, overlay=overlay, guards=guards)
    learned = trainer.pipeline.model.artifacts.learned()
    with torch.no_grad():
        for part in learned:
            part.alpha_logits.fill_(30.0)
    trainer.train()
    for part in learned:
        assert (part.alpha_logits.max() <= MATTE_LOGIT_RANGE[1] + 1e-4) == guards
    assert len(learned) == (overlay == "on")


@OVERLAYS
@pytest.mark.parametrize("guards", [True, False])
def test_start_points_inside_a_camera_are_left_out(tiny_scene, tmp_path, overlay, guards, make):
    count = len(make(tiny_scene, tmp_path / "a", overlay=overlay).pipeline.model.means)
    from ssa_nerfstudio.plugin.model import SSASplatfactoModel

    original = SSASplatfactoModel.start_outside_cameras

    def place_one_inside(model: SSASplatfactoModel, positions: Tensor) -> None:
        with torch.no_grad():
            model.means[5] = positions[2] + 0.001
            model.means[6] = positions[2] + 0.1
        original(model, positions)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SSASplatfactoModel, "start_outside_cameras", place_one_inside)
        trainer = make(tiny_scene, tmp_path / "b", overlay=overlay, guards=guards)
    shapes = {len(p) for p in trainer.pipeline.model.gauss_params.values()}
    assert shapes == {count - guards}
    trainer.train()


@OVERLAYS
def test_no_checkpoint_with_values_that_are_not_finite_is_written(tiny_scene, tmp_path, overlay, make):
    trainer = make(tiny_scene, tmp_path, overlay=overlay)
    trainer.save_checkpoint(0)
    with torch.no_grad():
        trainer.pipeline.model.quats[3, 1] = math.inf
    with pytest.raises(TrainingError, match=r"_model\.gauss_params\.quats"):
        trainer.save_checkpoint(1)
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000000.ckpt"]


@OVERLAYS
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_nor_one_whose_moments_are_not(tiny_scene, tmp_path, overlay, value, make):
    trainer = make(tiny_scene, tmp_path, steps=2, overlay=overlay)
    trainer.train()
    means = trainer.optimizers.optimizers["means"]
    means.state[means.param_groups[0]["params"][0]]["exp_avg_sq"][0] = value
    with pytest.raises(TrainingError, match=r"means\.state\.0\.exp_avg_sq"):
        trainer.save_checkpoint(7)
    assert not (trainer.checkpoint_dir / "step-000000007.ckpt").exists()


def test_the_guard_never_waits_for_the_device_between_two_checks():
    """Torch's own detector of host synchronization needs CUDA; here every way of reading a tensor is forbidden."""
    parameter = torch.nn.Parameter(torch.ones(3))
    optimizer = adam(parameter)
    guard = NonFiniteGuard(max_skipped_steps=5)

    def read(*_):
        raise AssertionError("the host read a tensor")

    with pytest.MonkeyPatch.context() as patch:
        for name in ("item", "tolist", "__bool__", "__float__", "__int__", "cpu", "numpy", "nonzero"):
            patch.setattr(Tensor, name, read)
        for value in (1.0, math.nan, 1.0):
            parameter.grad = torch.full((3,), value)
            verdict = guard.judge(LOSS, {"p": optimizer})
            with torch.no_grad():
                optimizer.update(verdict.skipped)
            guard.tell_densification({"radii": torch.ones(1, 3, dtype=torch.int32)})
    assert guard.check(2) == 1


def test_seed_points_that_are_not_finite_are_left_out_with_their_colors(caplog):
    points = torch.tensor([[0.0, 1.0, 2.0], [math.nan, 0.0, 0.0], [3.0, 4.0, math.inf], [5.0, 6.0, 7.0]])
    colors = torch.arange(12).reshape(4, 3)
    found = finite_points((points, colors))
    assert found is not None
    assert torch.equal(found[0], points[[0, 3]])
    assert torch.equal(found[1], colors[[0, 3]])
    bare = finite_points((points, colors[:0]))
    assert bare is not None
    assert (bare[0].shape, bare[1].shape) == ((2, 3), (0, 3))
    assert caplog.text.count("2 of the dataset's 4 3D points are not finite; they are left out") == 2
    caplog.clear()
    assert finite_points(None) is None
    assert finite_points((points[[0, 3]], colors[[0, 3]])) is not None
    assert not caplog.text
    assert finite_points((points[1:3], colors[1:3])) is None
    assert "no usable 3D points; starting from random ones" in caplog.text


def test_seed_points_in_one_place_get_the_usual_scale():
    scales = torch.tensor([[-3.0, -4.0, -5.0], [-math.inf, math.nan, -4.0], [math.inf, -4.0, -4.0]])
    replace_nonfinite_scales(scales)
    assert scales.tolist() == [[-3.0, -4.0, -5.0], [-4.0, -4.0, -4.0], [-4.0, -4.0, -4.0]]
    lonely = torch.full((2, 3), -math.inf)
    replace_nonfinite_scales(lonely)
    torch.testing.assert_close(lonely, torch.full((2, 3), math.log(0.01)))


def test_the_first_value_that_is_not_finite_is_named_by_its_place():
    sound = {"a": torch.ones(2), "b": [1.0, {"c": torch.tensor([1, 2])}, "text", None], "d": (torch.ones(1), 3)}
    assert first_nonfinite(sound) is None
    assert first_nonfinite({**sound, "e": [0.0, {"f": torch.tensor([1.0, math.nan])}]}) == "e.1.f"
    assert first_nonfinite({"x": (1.0, math.inf), "y": math.nan}) == "x.1"
    assert first_nonfinite(torch.tensor(math.nan), "loss") == "loss"


def test_scales_are_clamped_to_their_range():
    scales = torch.tensor([[-50.0, 0.0, 50.0]])
    clamp_scales(scales)
    assert torch.exp(scales.double())[0].tolist() == pytest.approx([1e-8, 1.0, 1e4], rel=1e-5)


def test_gaussians_with_any_broken_value_are_made_transparent():
    params = {"means": torch.zeros(4, 3), "quats": torch.ones(4, 4), "opacities": torch.zeros(4, 1)}
    params["means"][1, 2], params["quats"][2, 0], params["opacities"][3] = math.nan, math.inf, math.nan
    broken = mark_for_removal(params)  # pyright: ignore[reportArgumentType]
    assert broken.tolist() == [False, True, True, True]
    assert params["opacities"].flatten().tolist() == [0.0, -15.0, -15.0, -15.0]
