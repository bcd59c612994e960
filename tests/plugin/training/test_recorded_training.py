"""A training whose losses are recorded against one that launches everything one by one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from recordings import CUDA, recorder

from ssa_nerfstudio._system.cuda_graphs import RecordedCalls
from ssa_nerfstudio.plugin.photo_losses import PhotoLosses
from ssa_nerfstudio.plugin.trainer import SSATrainer

SETTINGS = pytest.mark.parametrize(
    "settings",
    [
        {},
        {"overlay": "off"},
        {"strategy": "mcmc", "ignore_background": False, "sparsity": "l1", "overlay_downscale": 2},
        {"shading": "affine", "overlay_start": "points"},
    ],
    ids=["default", "without overlay", "others", "shading"],
)


@pytest.fixture(scope="module")
def set_up(tiny_scene, tmp_path_factory, configure_training):
    """Make a trainer, halving photos for ten steps."""

    def make(device: str, settings: dict, scene: Path = tiny_scene) -> SSATrainer:
        options = {
            "overlay": "on",
            "overlay_start": "constant",
            "num_downscales": 1,
            "resolution_schedule": 10,
            **settings,
        }
        config = configure_training("ssa-splatfacto", scene, tmp_path_factory.mktemp("run"), 100, options)
        config.scale_schedules, config.machine.device_type = False, device
        torch.manual_seed(0)
        config.set_timestamp()
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        model = trainer.pipeline.model
        model._recorded = RecordedCalls(recorder(device), of_sum=True)
        scales = model.gauss_params["scales"].data  # of a sphere, the gradient of its rotation is rounding alone
        scales += 0.5 * torch.randn(scales.shape, generator=torch.Generator().manual_seed(0)).to(scales.device)
        return trainer

    return make


def record_losses(patch: pytest.MonkeyPatch, recorded: bool) -> None:
    """Record losses wherever they can be, or nowhere."""
    possible = PhotoLosses._can_be_recorded
    patch.setattr(PhotoLosses, "_losses_are_recorded", lambda self, depth: recorded and possible(self, depth))


@SETTINGS
def test_recorded_losses_train_the_same(set_up, monkeypatch, settings):
    trained = []
    for recorded in (False, True):
        record_losses(monkeypatch, recorded)
        trainer = set_up("cpu", settings)
        model = trainer.pipeline.model
        assert (model.shading is not None) == ("shading" in settings)
        for step in range(24):
            model.step_cb(trainer.optimizers, step)
            trainer.pipeline.train()
            trainer.train_iteration(step)
            model.step_post_backward(step)
        assert bool(model._recorded._known) == recorded
        trained.append(model.state_dict())
        monkeypatch.undo()
    for name, value in trained[0].items():
        assert not isinstance(value, torch.Tensor) or torch.equal(trained[1][name], value), name


def test_a_scaled_loss_is_not_recorded(set_up, monkeypatch):
    """A recording takes the gradient of the loss itself."""
    record_losses(monkeypatch, True)
    trainer = set_up("cpu", {})
    assert trainer.pipeline.model.recordable
    trainer.grad_scaler = torch.amp.GradScaler("cpu")
    trainer.setup_optimizers()
    model = trainer.pipeline.model
    model.step_cb(trainer.optimizers, 1)
    trainer.pipeline.train()
    assert all(value.requires_grad for value in trainer.pipeline.get_train_loss_dict(1)[1].values())


@SETTINGS
@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_recorded_losses_have_the_same_gradients(set_up, monkeypatch, device, settings):
    monkeypatch.setenv("SSA_CUDA_GRAPHS", "1")
    trainer = set_up(device, settings)
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    trainer.pipeline.train()
    possible = PhotoLosses._losses_are_recorded
    for step in (1, 2, 3, 4, 11, 12, 13):  # at half the size, then at the whole
        model.step_cb(trainer.optimizers, step)
        camera, batch = manager.next_train(step)
        found = []
        for recorded in (False, True):
            trainer.optimizers.zero_grad_some(list(trainer.optimizers.parameters))
            if not recorded or device == "cpu":
                record_losses(monkeypatch, recorded)
            torch.manual_seed(step)  # of the background
            losses = model.get_loss_dict(model(camera), batch)
            loss = torch.stack(list(losses.values())).sum()
            assert loss.requires_grad != recorded  # where they are recorded, nothing is left to differentiate
            if not recorded:
                loss.backward()
            found.append({f"loss {name}": value.detach().clone() for name, value in losses.items()})
            found[-1] |= {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}
            monkeypatch.setattr(PhotoLosses, "_losses_are_recorded", possible)
        assert found[0].keys() == found[1].keys()
        for name, expected in found[0].items():
            difference = (found[1][name] - expected).norm() / expected.norm().clamp_min(1e-20)
            assert difference <= (0 if device == "cpu" else 1e-4), (name, step)  # gsplat adds in any order
    recordings = [each for each in model._recorded._known.values() if each is not None]
    assert len(recordings) == 1


def test_cameras_of_two_groups_have_a_recording_each(set_up, monkeypatch, scene_of_two_cameras):
    """A recording composites the overlay of the group that it was made with."""
    gradients = []
    for recorded in (False, True):
        record_losses(monkeypatch, recorded)
        trainer = set_up("cpu", {}, scene_of_two_cameras)
        model = trainer.pipeline.model
        assert len(model.artifacts) == 2
        model.step_cb(trainer.optimizers, 20)
        trainer.pipeline.train()
        gradients.append([])
        for step in range(8):
            camera, batch = trainer.pipeline.datamanager.next_train(step)
            trainer.optimizers.zero_grad_some(list(trainer.optimizers.parameters))
            torch.manual_seed(step)
            loss = torch.stack(list(model.get_loss_dict(model(camera), batch).values())).sum()
            if loss.requires_grad:
                loss.backward()
            gradients[-1] += [None if p.grad is None else p.grad.clone() for p in model.artifacts.parameters()]
        monkeypatch.undo()
    assert [each is not None for each in model._recorded._known.values()] == [True, True]
    assert all((a is None) == (b is None) and (a is None or torch.equal(a, b)) for a, b in zip(*gradients, strict=True))


def test_recorded_steps_log_what_plain_ones_do(set_up, monkeypatch):
    logged = []
    for recorded in (False, True):
        record_losses(monkeypatch, recorded)
        trainer = set_up("cpu", {})
        trainer.pipeline.model.step_cb(trainer.optimizers, 20)
        trainer.pipeline.train()
        for _ in range(3):  # the third is a recording
            loss, losses, metrics = trainer.train_iteration(20)
        logged.append({"loss": loss, **losses, **metrics})
        monkeypatch.undo()
    assert "composite_psnr" in logged[0]
    assert logged[0] == logged[1]
