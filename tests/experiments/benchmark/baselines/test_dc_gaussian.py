"""DC-Gaussian's windscreen: its image formation, its gradients, and what it removes."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from torch import Tensor

from baselines.training import STEPS, reflection, train
from ssa_nerfstudio.experiments.benchmark.baselines.dc_gaussian import Windscreen


@pytest.mark.parametrize("reduction", [1, 2])
def test_the_windscreen_dims_adds_and_has_the_gradients_of_that(reduction):
    torch.manual_seed(0)
    screen = Windscreen(6, 8).double()
    screen.opacity.data[0] = -0.5
    clean = torch.rand(6 // reduction, 8 // reduction, 3, dtype=torch.float64, requires_grad=True)

    def formed(clean: Tensor, opacity: Tensor, added: Tensor) -> Tensor:
        parameters = {"opacity": opacity, "reflection": added}
        return torch.func.functional_call(screen, parameters, (clean, reduction))

    assert torch.autograd.gradcheck(formed, (clean, screen.opacity, screen.reflection))
    if reduction == 1:
        expected = (1 - screen.opacity.clamp_min(0)) * clean + screen.reflection
        torch.testing.assert_close(screen(clean, 1), expected)


@pytest.mark.slow
def test_it_finds_the_reflection_of_a_windscreen(capture, tmp_path):
    _, pipeline = train("dc-gaussian", capture("reflection"), tmp_path, STEPS)
    (screen,) = pipeline.model._windscreens()  # pyright: ignore
    found, true = screen.reflection.detach().mean(dim=-1).numpy(), reflection(48, 64).mean(axis=-1)
    assert np.corrcoef(found[2:-2, 2:-2].ravel(), true[2:-2, 2:-2].ravel())[0, 1] > 0.8
    assert float(pipeline.model.get_loss_dict(*_step(pipeline))["windscreen_opacity"].detach()) == pytest.approx(
        0.01 * float(screen.opacity.detach().clamp_min(0).mean())
    )


def test_every_camera_looks_through_its_own_windscreen(capture, tmp_path):
    folder = shutil.copytree(capture("clean"), tmp_path / "rig")
    meta = json.loads((folder / "transforms.json").read_text())
    length = meta.pop("fl_x")
    for number, frame in enumerate(meta["frames"]):
        frame["fl_x"] = length * (1.0 + 0.2 * (number % 2))
    (folder / "transforms.json").write_text(json.dumps(meta))
    _, pipeline = train("dc-gaussian", folder, tmp_path, 1)
    model = pipeline.model.train()
    screens = model._windscreens()  # pyright: ignore
    for screen, light in zip(screens, (0.1, 0.4), strict=True):
        screen.opacity.data.fill_(-1.0)
        screen.reflection.data.fill_(light)
    cameras = pipeline.datamanager.train_dataset.cameras
    added = set()
    for view in range(4):
        camera = cameras[view : view + 1]
        camera.metadata = {"cam_idx": view}
        drawn = model.get_outputs(camera)
        composite, scene = drawn["composite"], drawn["rgb"]
        assert composite is not None
        assert scene is not None
        light = float((composite - scene).mean().detach())
        added.add((round(float(camera.fx), 3), round(light, 3)))
    assert {light for _, light in added} == {0.1, 0.4}
    assert len(added) == 2  # each focal length has its own


@pytest.mark.slow
def test_it_restores_what_the_reflection_spoiled(gain):
    assert gain("dc-gaussian", "reflection") > 1.2


def _step(pipeline) -> tuple[dict, dict]:
    """Outputs of a training view and its batch."""
    pipeline.model.train()
    camera, batch = pipeline.datamanager.next_train(0)
    return pipeline.model.get_outputs(camera), batch
