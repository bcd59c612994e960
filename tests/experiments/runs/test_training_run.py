"""One training, as the benchmark does it: what is measured along it, what decides it, when it has diverged."""

from __future__ import annotations

import pytest

from ssa_nerfstudio.experiments.runs.run_configuration import configure, model_settings
from ssa_nerfstudio.experiments.runs.training_run import Diverged, train_and_evaluate

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
    config.optimizers["opacities"]["optimizer"].lr = 3e38  # infinite at the second step
    with pytest.raises(Diverged, match="not finite"):
        train_and_evaluate(config)
