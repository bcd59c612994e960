"""DeSplat: its Gaussians before a camera, its image formation, and what it takes out of the scene."""

from __future__ import annotations

import copy

import pytest
import torch

from baselines.training import train
from ssa_nerfstudio.experiments.benchmark.baselines import desplat
from ssa_nerfstudio.plugin.methods import METHODS
from ssa_nerfstudio.rasterization import rasterizer


def test_a_photos_gaussians_start_before_its_camera():
    made = desplat.start(1000)
    assert torch.equal(made["means"][:, 2], torch.full((1000,), desplat.DISTANCE))
    assert made["means"][:, :2].abs().max() <= desplat.SPREAD
    assert torch.sigmoid(made["opacities"]).allclose(torch.tensor(desplat.OPACITY))
    nearest = torch.cdist(made["means"], made["means"]).sort(dim=1).values[:, 1:4].mean(dim=1)
    torch.testing.assert_close(made["scales"].exp()[:, 0], nearest, atol=1e-6, rtol=1e-3)


@pytest.mark.parametrize(("steps", "factor"), [(30_000, 1.0), (15_000, 2.0), (7000, 4.0), (60_000, 1.0)])
def test_rates_of_what_belongs_to_single_photos_rise_in_short_trainings(steps, factor):
    config = copy.deepcopy(METHODS["ssa-splatfacto"])
    config.max_num_iterations = steps
    desplat.BASELINE.adapt(config)
    rates = {name: config.optimizers[f"distractor_{name}"]["optimizer"].lr for name in desplat.RATES}
    assert rates == pytest.approx({name: factor * rate for name, rate in desplat.RATES.items()})


def test_their_gradients_are_those_of_the_plain_rasterizer():
    torch.manual_seed(0)
    made = {name: values.double() for name, values in desplat.start(4).items()}
    made["means"][:, 2] += torch.tensor([0.0, 0.001, 0.002, 0.003])
    Ks = torch.tensor([[[20.0, 0.0, 8.0], [0.0, 20.0, 6.0], [0.0, 0.0, 1.0]]], dtype=torch.float64)
    scene = torch.rand(12, 16, 3, dtype=torch.float64)

    def composite(means, colors, opacities, scales):
        render, alpha, _ = rasterizer("reference", "cpu")(
            means, made["quats"], scales.exp(), opacities.sigmoid(), colors, torch.eye(4).double()[None], Ks, 16, 12
        )
        return (render[0] + (1 - alpha[0]) * scene).sum(), alpha.mean()

    inputs = tuple(made[name].requires_grad_() for name in ("means", "colors", "opacities", "scales"))
    assert torch.autograd.gradcheck(composite, inputs, atol=1e-4)


@pytest.fixture(scope="module")
def model(capture, tmp_path_factory):
    pipeline = train("desplat", capture("transient"), tmp_path_factory.mktemp("short"), 3, distractors=20)[1]
    pipeline.model.train()
    return pipeline


def test_the_loss_sees_both_scenes_and_the_regularizers_their_alphas(model):
    camera, batch = model.datamanager.next_train(0)
    outputs = model.model.get_outputs(camera)
    expected = outputs["composite"] - (1 - outputs["distractor_alpha"]) * outputs["rgb"]
    color, alpha = model.model._draw_distractors(camera)
    torch.testing.assert_close(expected, color)
    torch.testing.assert_close(outputs["distractor_alpha"], alpha)
    losses = model.model.get_loss_dict(outputs, batch)
    assert float(losses["distractors"].detach()) == pytest.approx(0.01 * float(alpha.detach().mean()))
    assert float(losses["emptiness"].detach()) == pytest.approx(
        0.01 * float(1 - outputs["accumulation"].detach().mean())
    )


def test_a_transparent_gaussian_moves_to_the_one_that_is_pulled_most(model):
    of = model.model
    of._view = 0
    of._of("opacities").data.fill_(2.0)
    of._of("opacities").data[3] = -8.0
    of._pull[0] = 0.0
    of._pull[0, 7] = 1.0
    before = of._of("scales").detach().clone()
    of._move_transparent(0)
    assert float(of._of("opacities")[3].detach()) == 2.0
    assert torch.equal(of._of("colors")[3], of._of("colors")[7])
    torch.testing.assert_close(of._of("scales")[7].exp() * desplat.SPLIT, before[7].exp())
    assert (of._of("means")[3] - of._of("means")[7]).abs().max() < 10 * before[7].exp().max()


@pytest.mark.slow
def test_it_takes_a_transient_distractor_out_of_the_scene(baked):
    assert baked("3dgs", "transient") > 0.1
    assert baked("desplat", "transient") < 0.3 * baked("3dgs", "transient")


@pytest.mark.slow
def test_it_restores_nothing_behind_a_watermark(gain):
    # A photo's own Gaussians explain the watermark, too, but with it what they like of the scene.
    assert gain("desplat", "watermark") < 0
