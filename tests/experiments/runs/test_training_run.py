"""One training, as the benchmark does it: what is measured along it, what decides it, when it has diverged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.guard_cost import Training
from ssa_nerfstudio.experiments.benchmark.execution.artifact_scores import score, true_layers
from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.runs.run_configuration import configure, model_settings
from ssa_nerfstudio.experiments.runs.training_run import Diverged, train_and_evaluate
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay

FULL = {"num_downscales": 0}


def test_on_and_off_are_words_where_a_setting_has_words_and_truths_where_it_has_those():
    given = ("overlay=On", "sparsity=off", "overlay_light=on", "guards=off", "use_absgrad=on", "sparsity_weight=0.5")
    assert model_settings(given) == {
        "overlay": "on",
        "sparsity": "off",
        "overlay_light": "on",
        "guards": False,
        "use_absgrad": True,
        "sparsity_weight": 0.5,
    }


@pytest.fixture(scope="module")
def along(tiny_scene, tmp_path_factory):
    """A run that is evaluated along its way, by several processes."""
    config = configure("ssa-splatfacto", tiny_scene, tmp_path_factory.mktemp("along"), 24, {**FULL, "overlay": "on"})
    return train_and_evaluate(config, marks=(6, 12, 24), flip_processes=2)[0]


def test_evaluating_along_the_way_and_in_processes_changes_nothing(along, tiny_scene, tmp_path):
    config = configure("ssa-splatfacto", tiny_scene, tmp_path, 24, {**FULL, "overlay": "on"})
    plain, _, _ = train_and_evaluate(config)
    assert plain.views == along.views
    assert plain.curve == []


def test_a_curve_rises_in_steps_and_seconds_and_ends_where_the_run_ends(along):
    assert [point["step"] for point in along.curve] == [6, 12, 24]
    seconds = [point["seconds"] for point in along.curve]
    assert seconds == sorted(seconds)
    assert seconds[-1] == pytest.approx(along.seconds["statistics"] + along.seconds["training"])
    assert along.curve[-1]["psnr"] == along.metrics["psnr"]
    assert along.seconds["statistics"] > 0
    assert along.seconds["evaluation"] > 0


def test_test_photos_keep_their_size_when_training_photos_are_reduced(tiny_scene, tmp_path):
    config = configure("ssa-splatfacto", tiny_scene, tmp_path, 4, FULL, scale_factor=0.5)
    _, pipeline, _ = train_and_evaluate(config, test_scale=1.0)
    assert pipeline.datamanager.cached_train[0]["image"].shape[:2] == (24, 32)
    assert pipeline.datamanager.cached_eval[0]["image"].shape[:2] == (48, 64)


def test_a_seed_decides_the_training(along, tiny_scene, tmp_path):
    config = configure("ssa-splatfacto", tiny_scene, tmp_path, 24, {**FULL, "overlay": "on"}, seed=1)
    assert train_and_evaluate(config)[0].metrics != along.metrics


@pytest.mark.parametrize("guards", [True, False])
def test_a_training_whose_gaussians_are_not_finite_has_diverged(tiny_scene, tmp_path, guards):
    config = configure("ssa-splatfacto", tiny_scene, tmp_path, 4, {**FULL, "overlay": "off", "guards": guards})
    config.optimizers["opacities"]["optimizer"].lr = float("inf")
    with pytest.raises(Diverged, match="not finite"):
        train_and_evaluate(config)


def _overlay(layers: Layers) -> ScreenSpaceOverlay:
    """An overlay that is the artifact, as far as one matte for all channels can be."""
    height, width = layers.matte.shape
    overlay = ScreenSpaceOverlay(height, width)
    alpha = torch.from_numpy(1 - layers.transmittance[..., :1])
    color = torch.from_numpy(layers.addition) / alpha.clamp_min(1e-3)
    with torch.no_grad():
        overlay.alpha_logits.copy_(alpha.logit(eps=1e-6))
        overlay.color_logits.copy_(color.logit(eps=1e-6))
    return overlay


def test_the_true_artifact_scores_best_and_none_scores_what_it_hides():
    matte = np.zeros((20, 30), np.float32)
    matte[10:] = 0.8
    layers = Layers.composited(matte, np.array([0.5, 0.25, 1.0]))
    right = score(_overlay(layers), layers.transmittance, layers.addition)
    assert right["matte_iou"] == 1
    assert max(right["matte_error"], right["premultiplied_error"], right["transmittance_error"]) < 1e-4
    nothing = Layers.composited(np.zeros((20, 30)), np.zeros(3))
    empty = score(_overlay(nothing), layers.transmittance, layers.addition)
    assert empty["matte_iou"] == 0
    assert empty["matte_error"] == pytest.approx(0.4, abs=1e-4)
    assert empty["premultiplied_error"] == pytest.approx(0.4 * 1.75 / 3, abs=1e-4)


def test_the_matte_of_added_light_is_the_least_opacity_that_explains_it():
    added = np.zeros((20, 30, 3), np.float32)
    added[:, :15, 1] = 0.6
    overlay = ScreenSpaceOverlay(20, 30)
    with torch.no_grad():
        overlay.alpha_logits.fill_(-20.0)
        overlay.alpha_logits[:, :15] = torch.tensor(0.6).logit()
        overlay.color_logits.fill_(-20.0)
        overlay.color_logits[:, :15, 1] = 20.0
    scores = score(overlay, np.ones_like(added), added)
    assert scores["matte_error"] == pytest.approx(0, abs=1e-5)
    assert scores["premultiplied_error"] == pytest.approx(0, abs=1e-5)
    assert scores["transmittance_error"] == pytest.approx(0.3, abs=1e-5)


def test_a_truth_of_another_size_is_averaged(tmp_path: Path):
    layers = Layers.composited(np.full((40, 60), 0.5), np.array([0.2, 0.4, 0.6]))
    np.savez(tmp_path / "layers.npz", T=layers.transmittance, B=layers.addition)
    small = Layers(layers.transmittance[::2, ::2].copy(), layers.addition[::2, ::2].copy())
    scores = score(_overlay(small), *true_layers(tmp_path / "layers.npz", 0, 1))
    assert scores["matte_error"] < 1e-5


def test_what_is_far_from_static_edges_waits_for_the_scene_and_is_learned_then(tiny_scene, tmp_path):
    config = configure("ssa-splatfacto", tiny_scene, tmp_path, 8, {**FULL, "overlay": "on", "scene_head_start": 4})
    config.scale_schedules = False
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    (overlay,) = trainer.pipeline.model.artifacts.learned()
    overlay.near[:, 20:] = 0
    start = overlay.alpha_logits.detach().clone()
    trainer.pipeline.train()
    training = Training(trainer)
    for step in range(8):
        training.step()
        moved = overlay.alpha_logits != start
        assert moved[:, :20].any()
        assert moved[:, 20:].any() == (step >= 4)
