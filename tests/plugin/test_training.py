"""Training in nerfstudio: what the methods build, what they learn, and that resuming goes on where a run stopped."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import edit_transforms
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from ssa_nerfstudio.evidence.statistics import accumulate
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.methods import METHODS
from ssa_nerfstudio.plugin.training.densification import MarkovChainMonteCarlo, gaussian_budget
from ssa_nerfstudio.plugin.training.schedules import scaled
from ssa_nerfstudio.rasterization.constants import NEAR_PLANE


@pytest.fixture(scope="session")
def run(configure_training, train_and_evaluate):
    def run(data: Path, output: Path, steps: int, method: str = "ssa-splatfacto", **model):
        return train_and_evaluate(
            configure_training(method, data, output, steps, {"num_downscales": 0, "overlay": "on", **model})
        )

    return run


@pytest.fixture(scope="session")
def dashboard_layers(draw_effect):
    def dashboard_layers(path: Path) -> Path:
        layers = draw_effect("dashboard", 48, 64)
        np.savez(path, T=layers.transmittance, B=layers.addition)
        return path

    return dashboard_layers


@pytest.fixture(scope="module")
def trained(tiny_scene, tmp_path_factory, dashboard_layers, run):
    """80 steps without, with a learned and with the true overlay, on the same scene."""
    folder = tmp_path_factory.mktemp("trained")
    given = dashboard_layers(folder / "layers.npz")
    return {
        # A folder each: nerfstudio names runs by the second, and two of these fit into one.
        "off": run(tiny_scene, folder / "off", 80, overlay="off"),
        "on": run(tiny_scene, folder / "on", 80),
        "given": run(tiny_scene, folder / "given", 80, overlay="given", overlay_given=given),
    }


def test_an_overlay_recovers_the_scene_behind_a_dashboard(trained):
    psnr = {name: outcome.metrics["psnr"] for name, (outcome, _, _) in trained.items()}
    assert psnr["on"] > psnr["off"] + 1.0
    assert psnr["given"] > psnr["off"] + 1.0


def test_the_matte_learned_is_the_dashboard(trained, draw_effect):
    _, pipeline, _ = trained["on"]
    truth = draw_effect("dashboard", 48, 64).matte
    matte = pipeline.model.artifacts.learned()[0].matte().numpy(force=True)[..., 0]
    assert matte[truth > 0.99].mean() > 0.9
    assert matte[truth < 0.01].mean() < 0.15


def test_rgb_is_the_clean_render_and_the_composite_is_what_the_photo_shows(trained):
    _, pipeline, _ = trained["on"]
    pipeline.eval()
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    drawn = pipeline.model.get_outputs_for_camera(camera)
    alpha, color = drawn["overlay_alpha"], drawn["overlay_rgb"]
    assert {name: tuple(drawn[name].shape) for name in ("rgb", "composite", "overlay_rgb", "overlay_alpha")} == {
        "rgb": (48, 64, 3),
        "composite": (48, 64, 3),
        "overlay_rgb": (48, 64, 3),
        "overlay_alpha": (48, 64, 1),
    }
    torch.testing.assert_close(drawn["composite"], alpha * color + (1 - alpha) * drawn["rgb"], atol=1e-5, rtol=0)
    bottom = (slice(40, None), slice(None))
    photos = torch.stack([view["image"].float() / 255 for view in pipeline.datamanager.cached_train])
    assert (drawn["composite"][bottom] - photos.mean(dim=0)[bottom]).abs().mean() < 0.1
    assert (drawn["rgb"][bottom] - photos.mean(dim=0)[bottom]).abs().mean() > 0.1


def test_without_an_overlay_there_is_none_of_it(trained):
    outcome, pipeline, _ = trained["off"]
    assert "overlay" not in pipeline.get_param_groups()
    assert not [name for name, _ in pipeline.model.named_parameters() if "overlay" in name]
    assert "composite_psnr" not in outcome.metrics


def test_a_given_overlay_is_buffers_and_does_not_learn(trained, draw_effect):
    _, pipeline, _ = trained["given"]
    layers = draw_effect("dashboard", 48, 64)
    assert "overlay" not in pipeline.get_param_groups()
    transmittance, addition = pipeline.model.artifacts[0].layers()
    np.testing.assert_array_equal(transmittance.numpy(force=True), layers.transmittance)
    np.testing.assert_array_equal(addition.numpy(force=True), layers.addition)


def same(state: dict, other: dict) -> bool:
    """Whether two states are equal bit by bit; not all entries are tensors."""
    pairs = ((state[name], other[name]) for name in state if name in other)
    return state.keys() == other.keys() and all(
        torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in pairs
    )


@pytest.mark.parametrize("kind", ["off", "on", "given"])
def test_a_checkpoint_reloads_without_opening_a_photo(trained, kind):
    _, pipeline, path = trained[kind]
    _, reloaded, _, _ = eval_setup(path, test_mode="inference")
    state, expected = reloaded.model.state_dict(), pipeline.model.state_dict()
    assert same(state, expected)
    assert "cached_train" not in vars(reloaded.datamanager)


def test_metrics_are_of_the_clean_render_and_complete(trained):
    outcome, _, _ = trained["on"]
    assert {"psnr", "ssim", "flip", "mean_color_deviation", "composite_psnr"} <= outcome.metrics.keys()
    # The test views are clean: with the artifact drawn in front they fit worse.
    assert outcome.metrics["psnr"] > outcome.metrics["composite_psnr"] + 1.0
    assert "lpips" not in outcome.metrics


@pytest.mark.skipif(torch.cuda.is_available(), reason="gsplat adds gradients up in any order")
def test_training_twice_gives_the_same_scene(tiny_scene, tmp_path, run):
    (_, a, _), (_, b, _) = (run(tiny_scene, tmp_path / name, 12) for name in "ab")
    assert same(a.model.state_dict(), b.model.state_dict())


@pytest.mark.parametrize(
    "model", [{}, {"overlay": "off"}, {"overlay_light": "on"}, {"strategy": "mcmc", "cap_max": 4200}]
)
def test_a_resumed_run_finishes_the_run_and_trains_what_it_loaded(
    tiny_scene, tmp_path, model, configure_training, train_and_evaluate
):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 20, {"num_downscales": 0, **model})
    config.max_num_iterations = 10
    _, first, path = train_and_evaluate(config)
    resumed = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 20, {"num_downscales": 0, **model})
    resumed.load_dir = path.parent / "nerfstudio_models"
    _, second, resumed_path = train_and_evaluate(resumed)
    checkpoints = sorted((resumed_path.parent / "nerfstudio_models").glob("step-*.ckpt"))
    assert [c.name for c in checkpoints] == ["step-000000019.ckpt"]
    saved = torch.load(checkpoints[0])
    assert saved["optimizers"]["means"]["state"][0]["step"] == 20
    means = {name: pipeline.model.means.detach() for name, pipeline in (("first", first), ("second", second))}
    assert not torch.equal(means["first"][:100], means["second"][:100])


def test_a_finished_run_is_not_trained_again(tiny_scene, tmp_path, configure_training, train_and_evaluate):
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 6, {"num_downscales": 0})
    _, first, path = train_and_evaluate(config)
    again = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 6, {"num_downscales": 0})
    again.load_dir = path.parent / "nerfstudio_models"
    _, second, _ = train_and_evaluate(again)
    assert torch.equal(first.model.means, second.model.means)


@pytest.mark.parametrize("method", sorted(METHODS))
@pytest.mark.parametrize("reduction", [0, 2])
def test_every_method_trains_at_full_and_reduced_resolution(
    tiny_scene, tmp_path, method, reduction, configure_training, train_and_evaluate
):
    model = {"num_downscales": reduction, "resolution_schedule": 15_000}
    outcome, pipeline, _ = train_and_evaluate(configure_training(method, tiny_scene, tmp_path, 12, model))
    assert np.isfinite(outcome.metrics["psnr"])
    assert all(torch.isfinite(p).all() for p in pipeline.model.parameters())


@pytest.mark.parametrize(
    "model",
    [
        {"overlay_downscale": 2, "num_downscales": 1},
        {"overlay_downscale": 4},
        {"overlay_start": "constant", "sparsity": "l1"},
        {"overlay_start": "constant", "overlay_light": "on"},
        {"sparsity": "off"},
        {"use_bilateral_grid": True},
        {"background_color": "white", "rasterize_mode": "antialiased"},
        {"sh_degree": 0},
        {"random_init": True, "num_random": 500},
        {"use_scale_regularization": True, "output_depth_during_training": True},
        {"rasterizer": "reference", "use_absgrad": False},
    ],
    ids=lambda model: "-".join(model),
)
def test_settings_can_be_combined(tiny_scene, tmp_path, model, configure_training, train_and_evaluate):
    outcome, pipeline, _ = train_and_evaluate(configure_training("ssa-splatfacto", tiny_scene, tmp_path, 4, model))
    assert np.isfinite(outcome.metrics["psnr"])
    size = -(-48 // model.get("overlay_downscale", 1)), -(-64 // model.get("overlay_downscale", 1))
    assert pipeline.model.artifacts.learned()[0].matte().shape[:2] == size


def test_the_start_is_the_statistics_of_the_training_photos(tiny_scene, tmp_path, run):
    _, pipeline, _ = run(tiny_scene, tmp_path, 1, overlay_start="statistics", overlay_film="kept")
    photos = pipeline.datamanager.cached_train
    deviation = accumulate((photo["image"], None) for photo in photos).deviation()
    expected = torch.exp(-deviation / 0.05).clamp(0.01, 0.99).float()
    # One step of Adam moves every logit by the learning rate, which a run as short as this has four times as high.
    drift = pipeline.model.artifacts.learned()[0].alpha_logits.detach() - expected.logit()
    assert drift.abs().max() < 4 * 0.0051


def test_light_in_front_of_the_photos_is_recognized_learned_and_reloaded(write_built_in_scene, tmp_path, run):
    """Spots that add to the scene: the model adds light, clips as a photo does, and a reloaded one still does."""
    scene = write_built_in_scene(tmp_path / "scene", views=12, test_views=3, width=64, height=48)
    rng = np.random.default_rng(0)
    spots = np.zeros((48, 64, 3), np.uint8)
    for y, x in rng.integers(2, (46, 62), (40, 2)):
        spots[y - 1 : y + 2, x - 1 : x + 2] = (70, 60, 50)
    names = json.loads((scene / "transforms.json").read_text())["train_filenames"]
    for name in names:
        with Image.open(scene / name) as photo:
            clean = np.asarray(photo.convert("RGB"))
        Image.fromarray((clean.astype(int) + spots).clip(0, 255).astype(np.uint8)).save(scene / name)
    _, pipeline, config = run(scene, tmp_path, 4, overlay="on")
    assert pipeline.model.artifacts.learned()[0].adds_light
    _, reloaded, _, _ = eval_setup(config, test_mode="inference")
    artifacts = reloaded.model.artifacts
    assert isinstance(artifacts, Artifacts)
    assert artifacts.learned()[0].adds_light
    assert artifacts.exceed_white


def test_masked_pixels_do_not_reach_the_overlay(broken_scene, tmp_path, run):
    from PIL import Image

    frames = json.loads((broken_scene / "transforms.json").read_text())["frames"]
    mask = np.full((48, 64), 255, np.uint8)
    mask[:10, :10] = 0
    Image.fromarray(mask).save(broken_scene / "mask.png")
    edit_transforms(broken_scene, frames=[{**frame, "mask_path": "mask.png"} for frame in frames])
    _, pipeline, _ = run(broken_scene, tmp_path, 3)
    matte = pipeline.model.artifacts.learned()[0].matte().detach()
    assert matte[:10, :10].max() < 0.02


def test_a_rig_gets_an_overlay_for_each_of_its_cameras(scene_of_two_cameras, tmp_path, run):
    _, pipeline, config = run(scene_of_two_cameras, tmp_path, 4)
    model = pipeline.model
    assert len(model.artifacts) == 2
    assert model.artifacts.camera_keys[:, 4].tolist() == sorted(model.artifacts.camera_keys[:, 4].tolist())
    assert set(model.artifacts._group_of_view) == {0, 1}
    assert not torch.equal(model.artifacts.learned()[0].alpha_logits, model.artifacts.learned()[1].alpha_logits)
    _, reloaded, _, _ = eval_setup(config, test_mode="inference")
    assert [name for name in reloaded.state_dict() if name.endswith("alpha_logits")] == [
        f"_model.artifacts.overlays.{g}.alpha_logits" for g in (0, 1)
    ]


def test_a_free_viewpoint_of_any_aspect_shows_the_overlay_unstretched(trained):
    _, pipeline, _ = trained["on"]
    pipeline.eval()
    camera = copy.deepcopy(pipeline.datamanager.eval_dataset.cameras[0:1])
    camera.width[:], camera.height[:] = 200, 48
    drawn = pipeline.model.get_outputs_for_camera(camera)
    assert drawn["overlay_alpha"].shape == (48, 200, 1)
    assert drawn["overlay_alpha"][:, :68].max() == 0
    assert drawn["overlay_alpha"][-4:, 70:130].mean() > 0.9


def test_mcmc_has_a_gaussian_for_150_pixels_of_the_photos_unless_a_number_is_stated(tiny_scene, tmp_path, run):
    few = {"strategy": "mcmc", "random_init": True, "num_random": 100}
    _, pipeline, _ = run(tiny_scene, tmp_path / "photos", 2, **few)
    assert pipeline.model.strategy.cap_max == round(12 * 64 * 48 / 150) == 246
    _, pipeline, _ = run(tiny_scene, tmp_path / "stated", 2, strategy="mcmc", cap_max=999)
    assert pipeline.model.strategy.cap_max == 999


@pytest.mark.parametrize(
    ("pixels", "seeds", "expected"),
    [(1_500, 4, 10), (1_500, 20, 20), (10**10, 9, 1_000_000), (10**10, 1_000_001, 1_000_001)],
)
def test_the_budget_of_gaussians_holds_the_seeds_and_else_at_most_a_million(pixels, seeds, expected):
    assert gaussian_budget(pixels, seeds) == expected


def test_a_resumed_run_keeps_mcmc_however_short_the_rest_is(
    tiny_scene, tmp_path, run, configure_training, train_and_evaluate
):
    _, _, path = run(tiny_scene, tmp_path, 4, strategy="mcmc", overlay="off")
    longer = {"num_downscales": 0, "overlay": "off"}
    resumed = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 6, longer)
    resumed.load_dir = path.parent / "nerfstudio_models"
    _, pipeline, _ = train_and_evaluate(resumed)
    assert isinstance(pipeline.model.strategy, MarkovChainMonteCarlo)


def test_mcmc_that_goes_on_from_adc_keeps_its_clearance(
    tiny_scene, tmp_path, run, configure_training, train_and_evaluate
):
    _, first, path = run(tiny_scene, tmp_path, 4, strategy="adc", overlay="off")
    plane = float(first.model.near_plane)
    assert plane > NEAR_PLANE
    other = {"num_downscales": 0, "overlay": "off", "strategy": "mcmc"}
    resumed = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 6, other)
    resumed.load_dir = path.parent / "nerfstudio_models"
    _, pipeline, _ = train_and_evaluate(resumed)
    assert float(pipeline.model.near_plane) == plane


@pytest.mark.parametrize(("trained", "stated"), [(0.5, 0.2), (0.5, 0.0), (0.0, 0.5)])
def test_a_resumed_run_has_its_own_clearance_and_what_loads_a_checkpoint_that_of_the_training(
    trained, stated, tiny_scene, tmp_path, run, configure_training, train_and_evaluate
):
    """In units of the depth of the nearest points: another run of the same photos says what that is."""
    _, usual, _ = run(tiny_scene, tmp_path / "usual", 1, overlay="off", clearance=0.5)
    nearest = float(usual.model.near_plane) / 0.5
    planes = {share: max(NEAR_PLANE, share * nearest) for share in (trained, stated)}
    _, first, path = run(tiny_scene, tmp_path / "first", 4, overlay="off", clearance=trained)
    assert float(first.model.near_plane) == pytest.approx(planes[trained])
    settings = {"num_downscales": 0, "overlay": "off", "clearance": stated}
    resumed = configure_training("ssa-splatfacto", tiny_scene, tmp_path / "resumed", 6, settings)
    resumed.load_dir = path.parent / "nerfstudio_models"
    _, pipeline, again = train_and_evaluate(resumed)
    assert float(pipeline.model.near_plane) == pytest.approx(planes[stated])
    assert pipeline.model._near_plane == pytest.approx(planes[stated])
    for config, share in ((path, trained), (again, stated)):
        _, reloaded, _, _ = eval_setup(config, test_mode="inference")
        assert reloaded.model._near_plane == pytest.approx(planes[share])


def test_every_schedule_is_scaled_with_the_length_of_the_run():
    config = copy.deepcopy(METHODS["ssa-splatfacto-mcmc"])
    config.max_num_iterations = 7_000
    short = scaled(config)
    model, full = short.pipeline.model, config.pipeline.model
    assert (model.warmup_length, model.refine_every, model.resolution_schedule) == (117, 23, 700)
    assert (model.stop_split_at, model.mcmc_stop_at, model.sh_degree_interval) == (3500, 5833, 233)
    assert model.stop_screen_size_at == 933
    assert short.optimizers["means"]["scheduler"].max_steps == 7_000
    assert short.optimizers["camera_opt"]["scheduler"].warmup_steps == 233
    assert (full.warmup_length, config.optimizers["means"]["scheduler"].max_steps) == (500, 30_000)


@pytest.mark.parametrize(("steps", "factor"), [(30_000, 1), (7_000, 1), (3_500, 2), (1_000, 4), (1, 4)])
def test_a_short_run_moves_the_overlay_faster(steps, factor):
    config = copy.deepcopy(METHODS["ssa-splatfacto"])
    config.max_num_iterations = steps
    assert scaled(config).optimizers["overlay"]["optimizer"].lr == pytest.approx(factor * 5e-3)
    assert config.optimizers["overlay"]["optimizer"].lr == 5e-3


@pytest.mark.parametrize(
    ("steps", "stated", "between"),
    [(30_000, 5_000, 5_000), (2_000, 5_000, 333), (300, 5_000, 100), (2_000, 50, 50), (2_000, 0, 0)],
)
def test_a_shorter_run_is_seen_too(steps, stated, between):
    config = copy.deepcopy(METHODS["ssa-splatfacto"])
    config.max_num_iterations, config.steps_per_eval_image = steps, stated
    assert scaled(config).steps_per_eval_image == between


def test_every_optimizer_is_scale_free():
    for config in METHODS.values():
        assert all(entry["optimizer"].eps == 1e-15 for entry in config.optimizers.values())


def test_a_preset_is_the_default_in_fewer_steps():
    default, fast = METHODS["ssa-splatfacto"], copy.deepcopy(METHODS["ssa-splatfacto-fast"])
    assert fast.max_num_iterations < default.max_num_iterations
    fast.method_name, fast.max_num_iterations = default.method_name, default.max_num_iterations
    assert fast == default


def test_the_papers_protocol_is_what_the_paper_says():
    config = METHODS["ssa-splatfacto-paper"]
    model = config.pipeline.model
    assert config.max_num_iterations == 30_000
    assert (model.sparsity, model.sparsity_weight, model.ssim_lambda) == ("l1", 0.05, 0.2)
    assert (model.background_color, model.num_downscales, model.use_absgrad) == ("black", 0, False)
    assert (model.densify_grad_thresh, model.cull_alpha_thresh) == (2e-4, 0.005)
    assert not model.ignore_background
    assert config.optimizers["overlay"]["optimizer"].lr == 5e-3
    assert config.optimizers["overlay"]["scheduler"] is None


def test_the_papers_protocol_scales_the_means_by_the_cameras_extent(
    tiny_scene, tmp_path, configure_training, train_and_evaluate
):
    config = configure_training("ssa-splatfacto-paper", tiny_scene, tmp_path, 2)
    _, pipeline, _ = train_and_evaluate(config)
    positions = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[:, :3, 3]
    extent = 1.1 * (positions - positions.mean(dim=0)).norm(dim=1).max()
    assert pipeline.model.scene_scale == pytest.approx(float(extent), rel=1e-5)
    assert pipeline.model.strategy_state["scene_scale"] == pipeline.model.scene_scale


def test_the_model_is_a_splatfacto_so_that_every_tool_accepts_it(trained):
    assert isinstance(trained["on"][1].model, SplatfactoModel)
