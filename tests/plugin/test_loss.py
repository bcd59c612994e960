"""The terms of the training's loss, each against its formula, and what a step draws and when."""

from __future__ import annotations

import copy

import pytest
import torch
from nerfstudio.models.splatfacto import resize_image

from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.photometric import photometric_loss
from ssa_nerfstudio.overlay.sparsity import MAX_WEIGHT, sparsity_loss
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.camera_matching import LENS_VALUES
from ssa_nerfstudio.plugin.methods import METHODS
from ssa_nerfstudio.plugin.training.schedules import scaled


@pytest.fixture(scope="module")
def trainer(tiny_scene, tmp_path_factory, configure_training):
    """A trainer that is set up; no step has been taken."""
    model = {"overlay": "on", "overlay_start": "constant", "num_downscales": 0, "strategy": "mcmc"}
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path_factory.mktemp("loss"), 100, model)
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.pipeline.model.step_cb(trainer.optimizers, 0)  # as before the first step
    trainer.pipeline.model.recordable = False  # on CUDA, too, a step draws its pictures
    return trainer


@pytest.fixture
def model(trainer):
    """Its model while training, with the settings that a test changes put back."""
    settings = copy.copy(trainer.pipeline.model.config)
    artifacts = trainer.pipeline.model.artifacts
    trainer.pipeline.train()
    yield trainer.pipeline.model
    trainer.pipeline.model.config = settings
    trainer.pipeline.model.artifacts = artifacts
    trainer.pipeline.model.step = 0


SHOWN, PHOTO = (torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1))


def losses(model, **batch) -> dict[str, torch.Tensor]:
    outputs = {"rgb": torch.zeros(48, 64, 3), "composite": SHOWN, "background": torch.zeros(3)}
    outputs = {name: value.to(model.device) for name, value in outputs.items()}
    return model.get_loss_dict(outputs, {"image": PHOTO, **batch})


def assert_close(found: torch.Tensor, expected: torch.Tensor) -> None:
    """Equal to float32's rounding, on whichever devices they are."""
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7, check_device=False)


@pytest.mark.parametrize(("downscales", "reduction"), [(0, 1), (1, 2), (2, 4)])
def test_a_photo_is_reduced_as_upstream_reduces_it(model, downscales, reduction):
    model.config.num_downscales = downscales
    photo = (255 * PHOTO).to(torch.uint8)
    expected = resize_image(photo.float() / 255, reduction) if reduction > 1 else photo.float() / 255
    assert_close(model.get_gt_img(photo).cpu(), expected)


@pytest.mark.parametrize("image", [PHOTO[:47, :63], PHOTO[..., :1] > 0.5], ids=["odd", "bool"])
def test_any_image_is_reduced_as_upstream_reduces_it(model, image):
    model.config.num_downscales = 2
    assert_close(model._downscale_if_required(image), resize_image(image, 4))


def test_what_a_mask_excludes_is_no_part_of_the_loss(model):
    mask = torch.ones(48, 64, 1)
    mask[:, :20] = 0
    masked = losses(model, mask=mask.bool())["main_loss"]
    assert_close(masked, photometric_loss(SHOWN * mask, PHOTO * mask, model.config.ssim_lambda))
    elsewhere = PHOTO.clone()
    elsewhere[:, :20] = 0.123
    assert losses(model, image=elsewhere, mask=mask.bool())["main_loss"] == masked
    assert losses(model)["main_loss"] != masked


def test_the_loss_of_a_test_photo_is_of_the_clean_render(model):
    model.eval()
    rendered = photometric_loss(torch.zeros(48, 64, 3), PHOTO, model.config.ssim_lambda)
    assert_close(losses(model)["main_loss"], rendered)


@pytest.mark.parametrize("groups", [(0, 1), (0, 0, 0, 1), (0, 2, 1, 2)], ids=str)
def test_overlays_weigh_as_much_as_the_photos_that_show_them(model, groups):
    """The last of three groups has no overlay, and its photos no sparsity."""
    one = losses(model)["sparsity"]
    weight = MAX_WEIGHT  # of photos whose noise nobody knows
    own = model.artifacts.learned()[0]
    assert_close(one, weight * sparsity_loss(own.opacity(), own.evidence, "log"))
    other = ScreenSpaceOverlay(48, 64).to(model.device)
    with torch.no_grad():
        other.alpha_logits.add_(3)
    of_views = [groups[view % len(groups)] for view in range(model.num_train_data)]
    model.artifacts, count = Artifacts().to(model.device), 1 + max(groups)
    model.artifacts.assign([own, other, None][:count], torch.zeros(count, 6), of_views, torch.zeros(count, LENS_VALUES))
    first, second = (of_views.count(group) / len(of_views) for group in (0, 1))
    expected = weight * sparsity_loss(other.opacity(), other.evidence, "log")
    assert_close(losses(model)["sparsity"], first * one + second * expected)


@pytest.mark.parametrize(
    ("stated", "noise", "weight"),
    [(None, 0.004, 0.004), (None, 0.05, MAX_WEIGHT), (0.05, 0.004, 0.05), (0.0, 0.01, 0.0)],
)
def test_sparsity_weighs_no_more_than_the_noise_unless_its_weight_is_stated(model, stated, noise, weight):
    own = model.artifacts.learned()[0]
    model.config.sparsity_weight = stated
    own.noise.fill_(noise)
    found = losses(model)["sparsity"]
    own.noise.fill_(1.0)
    assert_close(found, weight * sparsity_loss(own.opacity(), own.evidence, "log"))


def test_mcmc_pays_for_opacity_and_for_size(model):
    terms = losses(model)
    assert_close(terms["opacity_reg"], 0.01 * torch.sigmoid(model.opacities).mean())
    assert_close(terms["mcmc_scale_reg"], 0.01 * torch.exp(model.scales).mean())
    model.config.strategy = "adc"
    assert not {"opacity_reg", "mcmc_scale_reg"} & losses(model).keys()


def test_long_gaussians_are_penalized_every_tenth_step(model):
    model.config.use_scale_regularization, model.config.max_gauss_ratio = True, 1.5
    for step, paid in ((0, True), (9, False), (10, True)):
        model.step = step
        assert ("scale_reg" in losses(model)) == paid
    before = model.scales.detach().clone()
    with torch.no_grad():
        model.scales[::2, 1] += 2.0  # every other one is at least twice as long as wide
        model.scales[1::2] = -3.0
    sizes = torch.exp(model.scales)
    ratio = sizes.amax(dim=-1) / sizes.amin(dim=-1)
    penalty = losses(model)["scale_reg"]
    assert penalty > 0.05
    assert_close(penalty, 0.1 * (ratio.clamp_min(1.5) - 1.5).mean())
    with torch.no_grad():
        model.scales.copy_(before)


def test_harmonics_come_one_degree_at_a_time(model, trainer):
    camera, _ = trainer.pipeline.datamanager.next_train(0)
    with torch.no_grad():
        model.features_rest[:, :3] += 0.5  # of degree 1 alone
    model.config.sh_degree_interval = 10

    def drawn(step: int) -> torch.Tensor:
        model.step_cb(trainer.optimizers, step)
        torch.manual_seed(0)  # of the background
        return model.get_outputs(camera)["rgb"]

    constant, first, everything = drawn(9), drawn(10), drawn(1000)
    with torch.no_grad():
        model.features_rest[:, :3] -= 0.5
    assert not torch.equal(constant, first)
    assert_close(first, everything)


def test_every_view_is_drawn_once_before_any_comes_again(trainer):
    manager = trainer.pipeline.datamanager
    manager.train_unseen_cameras = manager.sample_train_cameras()
    for _ in range(2):
        drawn = [manager.next_train(step)[1]["image_idx"] for step in range(12)]
        assert sorted(drawn) == list(range(12))


@pytest.mark.parametrize("of_model", [True, False])
def test_all_modules_learn_again_after_a_look_at_the_scene(trainer, of_model):
    """The viewer looks at the model, nerfstudio's evaluation at the pipeline."""
    (trainer.pipeline.model if of_model else trainer.pipeline).eval()
    assert not trainer.pipeline.model.artifacts.training
    trainer.pipeline.train()
    assert all(module.training for module in trainer.pipeline.modules())


@pytest.mark.parametrize("steps", [3_000, 15_000, 60_000])
def test_the_means_rate_follows_the_length(steps):
    config = copy.deepcopy(METHODS["ssa-splatfacto"])
    config.max_num_iterations = steps
    found = scaled(config)
    assert found.optimizers["means"]["scheduler"].max_steps == steps


def test_the_means_rates_are_in_units_of_the_scene(trainer):
    before = {name: copy.deepcopy(entry) for name, entry in trainer.config.optimizers.items()}
    try:
        trainer.pipeline.model.scene_scale = 2.5  # as `scale_by_extent` sets it
        trainer.setup_optimizers()
        means = trainer.config.optimizers["means"]
        assert means["optimizer"].lr == pytest.approx(2.5 * before["means"]["optimizer"].lr)
        assert means["scheduler"].lr_final == pytest.approx(2.5 * before["means"]["scheduler"].lr_final)
    finally:
        trainer.pipeline.model.scene_scale = 1.0
        trainer.config.optimizers = before


@pytest.mark.parametrize("ignored", [True, False])
def test_hiding_background_moves_the_matte_only_where_that_is_asked_for(model, trainer, ignored):
    """No splat is seen, and the photo has the overlay's color."""
    camera, _ = trainer.pipeline.datamanager.next_train(0)
    model.config.ignore_background = ignored
    overlay = model.artifacts.learned()[0]
    before = model.opacities.detach().clone()
    with torch.no_grad():
        model.opacities.fill_(-20.0)
    try:
        shown = model.get_outputs(camera)["composite"]
        (gradient,) = torch.autograd.grad((shown - overlay.color().detach()).square().mean(), overlay.alpha_logits)
    finally:
        with torch.no_grad():
            model.opacities.copy_(before)
    assert (gradient.abs().max() < 1e-9) == ignored
