"""Each guard, with the overlay on and off, and what happens without it."""

from __future__ import annotations

import copy
import math
from collections import Counter

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import ssa_nerfstudio.plugin.methods  # noqa: F401 - installs the CPU bodies that gsplat lacks
from benchmarks.guards import Training
from ssa_nerfstudio.errors import TrainingError
from ssa_nerfstudio.overlay.layer import MATTE_LOGIT_RANGE, ScreenSpaceOverlay
from ssa_nerfstudio.plugin.trainer import SSATrainer, machine
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdam
from ssa_nerfstudio.plugin.training.nonfinite import (
    RANGE_EVERY,
    SCALE_RANGE,
    SeededLoss,
    SeedingScaler,
    StepGuard,
    first_not_finite,
    keep_scales_in_range,
)

OVERLAYS = pytest.mark.parametrize("overlay", ["on", "off"])


@pytest.fixture(scope="session")
def make(configure_training):
    def make(data, output, steps: int = 4, method: str = "ssa-splatfacto", **settings) -> SSATrainer:
        """A trainer that has been set up and has not begun; settings of the trainer and of the model."""
        torch.manual_seed(0)
        own = {
            name: settings.pop(name) for name in ("use_grad_scaler", "gradient_accumulation_steps") if name in settings
        }
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
    pipeline = trainer.pipeline
    original = pipeline.get_train_loss_dict
    hooks: list = []

    def get_train_loss_dict(step: int):
        while hooks:
            hooks.pop().remove()
        outputs, losses, metrics = original(step)
        if step in steps and what == "loss":
            # A loss that is not finite without a gradient that is not: only the loss tells.
            losses["broken"] = losses["main_loss"].new_tensor(value)
        elif step in steps:
            parameter = pipeline.get_param_groups()[what][0]
            poison = torch.zeros_like(parameter)
            poison.view(-1)[0] = value
            hooks.append(parameter.register_hook(lambda gradient: gradient + poison))
        return outputs, losses, metrics

    pipeline.get_train_loss_dict = get_train_loss_dict


def state(trainer: SSATrainer) -> dict[str, Tensor]:
    """Every parameter, every moment and step of Adam, and the densification's sums, copied, after a look."""
    trainer.optimizers.look(trainer.step)
    found: dict[str, Tensor] = {**trainer.pipeline.state_dict()}
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


@OVERLAYS
@pytest.mark.parametrize("what", ["scales", "means", "loss", "overlay"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_step_that_is_not_finite_leaves_everything_as_it_was(tiny_scene, tmp_path, overlay, what, value, make):
    if what == "overlay" and overlay == "off":
        pytest.skip("there is no overlay whose gradient could break")
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
    assert first_not_finite(states[3]) is None


def changed(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    """What differs."""
    return {name for name in before if not torch.equal(before[name], after[name])}


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
def test_the_guard_never_waits_for_the_device_and_does_little(tiny_scene, tmp_path, overlay, method, make):
    """Between two looks: reading one number (`_local_scalar_dense`) would make the host wait at every step."""
    counts: dict[bool, Counter[str]] = {}
    for guards in (True, False):
        trainer = make(tiny_scene, tmp_path / str(guards), steps=8, method=method, overlay=overlay, guards=guards)
        trainer.pipeline.train()
        training = Training(trainer)
        for _ in range(3):
            with Operations() as operations:
                training.step()
        counts[guards] = operations.counts
    more = counts[True] - counts[False]
    assert more["_local_scalar_dense"] == 0
    assert more["item"] == 0
    launched = more.total() - more["view"] - more["detach"] - more["alias"]
    fewer = counts[False] - counts[True]
    # Seed instead of ones, and search; MCMC's noise waits for the judgement.
    assert launched - fewer.total() <= (2 if "mcmc" in method else 1)


@OVERLAYS
def test_without_the_guard_such_a_step_spoils_the_parameters(tiny_scene, tmp_path, overlay, make):
    trainer = make(tiny_scene, tmp_path, overlay=overlay, guards=False)
    spoil(trainer, {2})
    states = after_each_step(trainer)
    with pytest.raises(TrainingError, match="holds values that are not finite"):
        trainer.train()
    assert first_not_finite(states[1]) is None
    assert not torch.isfinite(states[2]["_model.gauss_params.scales"]).all()


@OVERLAYS
def test_the_statistics_of_a_broken_step_are_left_out_and_spoilt_without_the_guard(tiny_scene, tmp_path, overlay, make):
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


def go_back(parameter: torch.nn.Parameter, gradient: Tensor, guard: StepGuard) -> None:
    """Let a parameter have a gradient, as in a training."""
    parameter.grad = None
    loss = parameter.sum() * 0.0 + 1.0  # the gradient comes from the hook: products with numbers would round it
    handle = parameter.register_hook(lambda ones: torch.full_like(ones, guard.magnification) * gradient)
    SeededLoss(loss, guard).backward()
    handle.remove()


def test_a_gradient_whose_square_overflows_is_skipped_because_it_would_freeze_or_break_its_element():
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = FusedAdam([parameter], lr=0.1, eps=1e-15)
    frozen = torch.nn.Parameter(torch.zeros(3))
    plain = torch.optim.Adam([frozen], lr=0.1, fused=True, eps=1e-15)
    guard = StepGuard(limit=10)
    guard.watch(optimizer)
    for largest in (1e22, 1.0, 1.0):
        gradient = torch.tensor([largest, 1.0, 1.0])
        go_back(parameter, gradient, guard)
        frozen.grad = gradient.clone()
        guard.judge({"p": optimizer})
        optimizer.step()
        plain.step()
    torch.testing.assert_close(parameter.detach(), torch.full((3,), -0.2))
    assert abs(frozen.detach()[0]) < 0.11
    assert torch.isinf(plain.state[frozen]["exp_avg_sq"][0])


def test_what_has_a_finite_square_is_not_skipped_and_is_judged_to_the_last_bit(capsys):
    parameter = torch.nn.Parameter(torch.zeros(3))
    optimizer = FusedAdam([parameter], lr=0.1)
    guard = StepGuard(limit=10)
    for largest, skipped in ((1.8e19, 0), (1.85e19, 1)):
        gradient = torch.tensor([-largest, 1.0, 1e-42])  # the last one is subnormal
        go_back(parameter, gradient, guard)
        assert bool(torch.isinf(gradient.square()).any()) == skipped
        guard.judge({"p": optimizer})
        assert guard.skipped == skipped
        assert parameter.grad is not None
        assert torch.equal(parameter.grad, gradient) != skipped
    guard.look(1)
    assert "the gradient of p was not finite" in capsys.readouterr().err


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38])
def test_the_backward_pass_begins_with_a_power_of_two_or_nothing_usable(value):
    guard = StepGuard(limit=10)
    parameter = torch.nn.Parameter(torch.tensor(1.0, device=machine().device_type))
    SeededLoss(parameter + value, guard).backward()
    assert bool(parameter.grad == 2.0**64) == math.isfinite(value)
    guard.judge({"p": torch.optim.SGD([parameter], lr=0.1)})
    assert guard.skipped == (not math.isfinite(value))


@pytest.mark.skipif(torch.cuda.is_available(), reason="gsplat adds gradients up in any order")
@OVERLAYS
@pytest.mark.parametrize("method", ["ssa-splatfacto", "ssa-splatfacto-mcmc"])
def test_a_sound_training_is_the_same_to_the_last_bit_without_guards(tiny_scene, tmp_path, overlay, method, make):
    """Gradients 2^64 times as large: nothing overflows on the way back, and nothing is rounded otherwise."""
    states = {}
    for guards in (True, False):
        trainer = make(tiny_scene, tmp_path / str(guards), method=method, overlay=overlay, guards=guards)
        states[guards] = after_each_step(trainer)
        trainer.train()
    assert changed(states[True][-1], states[False][-1]) == set()
    assert changed(states[True][0], states[True][-1])


@pytest.mark.parametrize("kind", ["ours", "fused", "foreach", "single", "sgd"])
@pytest.mark.parametrize("scaler", [False, True])
def test_any_optimizer_skips_and_then_goes_on(kind, scaler):
    parameter = torch.nn.Parameter(torch.ones(4))
    if kind == "sgd":
        optimizer: torch.optim.Optimizer = torch.optim.SGD([parameter], lr=0.1, momentum=0.9)
    elif kind == "ours":
        optimizer = FusedAdam([parameter], lr=0.1)
    else:
        fused, foreach = kind == "fused", kind == "foreach"
        optimizer = torch.optim.Adam([parameter], lr=0.1, fused=fused, foreach=None if fused else foreach)
    guard = StepGuard(limit=10, magnified=False)
    guard.watch(optimizer)
    grad_scaler = torch.amp.GradScaler("cpu", enabled=scaler, init_scale=4.0, growth_interval=1000)
    seen = []
    for value in (1.0, math.nan, 1.0):
        parameter.grad = torch.full((4,), value)
        # What breaks may belong to another optimizer: this one's gradient is fine and it must skip all the same.
        other = torch.nn.Parameter(torch.zeros(1))
        other.grad, parameter.grad = parameter.grad[:1].clone(), torch.ones(4) * (4.0 if scaler else 1.0)
        guard.judge({"p": optimizer, "other": torch.optim.SGD([other], lr=0.1)})
        grad_scaler.scale(torch.ones(()))  # a scaler makes its state on first use
        grad_scaler.step(optimizer)
        grad_scaler.update()
        seen.append(parameter.detach().clone())
    assert torch.equal(seen[0], seen[1])
    assert (seen[2] < seen[1]).all()


def test_what_a_gradient_scaler_finds_by_itself_is_skipped_too():
    parameter = torch.nn.Parameter(torch.ones(4))
    optimizer = torch.optim.Adam([parameter], lr=0.1, fused=True)
    guard = StepGuard(limit=10, magnified=False)
    guard.watch(optimizer)
    parameter.grad = torch.ones(4)
    assert guard.judge({"p": optimizer}) == 0
    optimizer.found_inf = torch.ones(())  # pyright: ignore[reportAttributeAccessIssue] - as GradScaler.step sets it
    optimizer.step()
    assert torch.equal(parameter, torch.ones(4))


@pytest.mark.parametrize("magnified", [True, False])
def test_a_loss_is_scaled_and_seeded(magnified):
    """nerfstudio's own scaler is enabled for mixed precision only, and on CUDA only."""
    guard = StepGuard(limit=10, magnified=magnified)
    parameter = torch.nn.Parameter(torch.tensor(3.0))
    scaler = SeedingScaler(guard, enabled=True, device="cpu")
    scaler.scale(2 * parameter).backward()
    assert parameter.grad == 2 * scaler.get_scale() * guard.magnification
    guard.judge({"p": torch.optim.SGD([parameter], lr=0.1)})
    assert parameter.grad == 2 * scaler.get_scale()


@pytest.mark.parametrize("asked", [True, False])
def test_gradients_of_half_precision_are_not_magnified(tiny_scene, tmp_path, asked, make):
    trainer = make(tiny_scene, tmp_path, use_grad_scaler=asked)
    scaling = asked and torch.cuda.is_available()  # elsewhere torch's scaler says that it is off
    guard = trainer.optimizers.guard
    assert guard is not None
    assert (guard.magnification == 1) == scaling
    assert trainer.grad_scaler.is_enabled() == scaling
    trainer.train()
    assert guard.skipped == 0


@OVERLAYS
@pytest.mark.parametrize("what", ["quats", "means", "loss", "large"])
def test_where_gradients_add_up_a_broken_step_is_skipped_by_those_too_that_only_gather(
    tiny_scene, tmp_path, overlay, what, make
):
    """Step 2 is one at which quaternions gather: a step of theirs is every second."""
    trainer = make(tiny_scene, tmp_path, overlay=overlay, gradient_accumulation_steps={"quats": 2})
    spoil(trainer, {2}, "quats" if what == "large" else what, 1e25 if what == "large" else math.nan)
    states = after_each_step(trainer)
    trainer.train()
    assert changed(states[1], states[2]) == set()
    assert {"_model.gauss_params.quats", "_model.gauss_params.means"} <= changed(states[0], states[1])
    assert first_not_finite(states[3]) is None


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


def test_a_checkpoint_between_two_looks_holds_the_steps_that_were_taken(tiny_scene, tmp_path, make):
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
def test_training_stops_after_so_many_in_a_row_and_names_parameter_and_step(
    tiny_scene, tmp_path, capsys, overlay, make
):
    trainer = make(tiny_scene, tmp_path, steps=110, overlay=overlay, max_skipped_steps=20, stop_split_at=1)
    spoil(trainer, range(40, 110), "opacities")
    with pytest.raises(TrainingError):
        trainer.train()
    assert trainer.step == 99, "the host looks every 100 steps"
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "stopped at step 99: 20 steps in a row, from step 40 on" in line
    assert "the gradient of opacities was not finite" in line


def test_skipped_steps_that_are_not_in_a_row_are_told_and_endured(tiny_scene, tmp_path, capsys, make):
    trainer = make(tiny_scene, tmp_path, steps=200, max_skipped_steps=3, stop_split_at=1)
    spoil(trainer, set(range(0, 200, 3)) | set(range(2, 200, 3)), "quats")
    trainer.train()
    told = capsys.readouterr().err
    assert "67 of the 100 steps up to 99 were skipped: the gradient of quats was not finite" in told
    # The 200th was taken, and left no trace of what was wrong with those before.
    assert "66 of the 100 steps up to 199 were skipped: the loss or a gradient was not finite" in told


def test_if_all_breaks_all_is_named():
    guard = StepGuard(limit=1)
    parameters = [torch.nn.Parameter(torch.ones(2)) for _ in range(3)]
    optimizers = {name: torch.optim.SGD([p], lr=1.0) for name, p in zip("abc", parameters, strict=True)}
    for parameter in parameters[:2]:  # the third has none
        parameter.grad = torch.full((2,), math.inf)
    guard.judge(optimizers)
    with pytest.raises(TrainingError, match="because every gradient was not finite"):
        guard.look(0)


def test_if_the_loss_breaks_it_alone_is_named():
    guard = StepGuard(limit=1)
    parameters = [torch.nn.Parameter(torch.ones(2)) for _ in range(2)]
    SeededLoss((parameters[0] + parameters[1]).sum() * math.inf, guard).backward()
    guard.judge({name: torch.optim.SGD([p], lr=1.0) for name, p in zip("ab", parameters, strict=True)})
    with pytest.raises(TrainingError, match="because the loss was not finite"):
        guard.look(0)


def test_a_row_of_skipped_steps_is_counted_across_looks():
    guard = StepGuard(limit=30)
    parameter = torch.nn.Parameter(torch.ones(2))
    optimizers: dict[str, torch.optim.Optimizer] = {"p": torch.optim.SGD([parameter], lr=1.0)}
    for step in range(200):
        parameter.grad = torch.full((2,), math.inf if 85 <= step < 115 else 1.0)
        guard.judge(optimizers)
        if step == 99:
            assert guard.look(step) == list(range(85, 100))
    with pytest.raises(TrainingError, match="from step 85 on"):
        guard.look(199)


def test_the_culprit_is_the_parameter_whose_value_broke():
    guard = StepGuard(limit=1)
    broken, fine = (torch.nn.Parameter(torch.ones(2)) for _ in range(2))
    broken.data[0] = math.nan
    for parameter in (broken, fine):
        parameter.grad = torch.full((2,), math.nan)
    optimizers = {name: torch.optim.SGD([p], lr=1.0) for name, p in (("b", broken), ("f", fine))}
    guard.judge(optimizers)
    with pytest.raises(TrainingError, match=r"b \(the values themselves\)"):
        guard.look(0)


@OVERLAYS
@pytest.mark.parametrize("guards", [True, False])
def test_log_scales_stay_in_range(tiny_scene, tmp_path, overlay, guards, make):
    trainer = make(tiny_scene, tmp_path, steps=RANGE_EVERY + 1, overlay=overlay, guards=guards)
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
    keep_scales_in_range(log_scales)
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
    trainer = make(tiny_scene, tmp_path, steps=RANGE_EVERY + 1, overlay=overlay, guards=guards)
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
def test_no_checkpoint_with_values_that_are_not_finite_is_written(tiny_scene, tmp_path, capsys, overlay, make):
    trainer = make(tiny_scene, tmp_path, overlay=overlay)
    trainer.save_checkpoint(0)
    with torch.no_grad():
        trainer.pipeline.model.quats[3, 1] = math.inf
    with pytest.raises(TrainingError):
        trainer.save_checkpoint(1)
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000000.ckpt"]
    assert "_model.gauss_params.quats" in capsys.readouterr().err


@OVERLAYS
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_nor_one_whose_moments_are_not(tiny_scene, tmp_path, capsys, overlay, value, make):
    trainer = make(tiny_scene, tmp_path, steps=2, overlay=overlay)
    trainer.train()
    means = trainer.optimizers.optimizers["means"]
    means.state[means.param_groups[0]["params"][0]]["exp_avg_sq"][0] = value
    with pytest.raises(TrainingError):
        trainer.save_checkpoint(7)
    assert "means.state.0.exp_avg_sq" in capsys.readouterr().err
    assert not (trainer.checkpoint_dir / "step-000000007.ckpt").exists()


def test_the_guard_never_waits_for_the_device_between_two_looks():
    """Torch's own detector of host synchronization needs CUDA; here every way of asking a tensor is forbidden."""
    parameter = torch.nn.Parameter(torch.ones(3))
    optimizer = FusedAdam([parameter], lr=0.1)
    guard = StepGuard(limit=5)
    guard.watch(optimizer)

    def asked(*_):
        raise AssertionError("the host asked a tensor for its value")

    with pytest.MonkeyPatch.context() as patch:
        for name in ("item", "tolist", "__bool__", "__float__", "__int__", "cpu", "numpy", "nonzero"):
            patch.setattr(Tensor, name, asked)
        for value in (1.0, math.nan, 1.0):
            parameter.grad = torch.full((3,), value)
            guard.judge({"p": optimizer})
            optimizer.step()
    assert guard.look(2) == [1]
