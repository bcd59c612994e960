"""Distant points become Gaussians: those that photos show before the first step, those that none shows after the last.

What they are, tests/evidence/test_distant_points.py tests; here it is stated.
"""

from __future__ import annotations

import math

import pytest
import torch

from ssa_nerfstudio.evidence.distant_points import DistantPoints
from ssa_nerfstudio.plugin import distant_seeds

FOUND = DistantPoints(torch.tensor([[0.0, 0.0, 40.0], [1.0, 0.0, 40.0]]), torch.tensor([[0.2, 0.4, 0.9]] * 2), 1.0)
HIDDEN = DistantPoints(torch.tensor([[0.0, 1.0, 40.0]]), torch.tensor([[0.9, 0.5, 0.1]]), 1.0)


@pytest.fixture
def stated_points(monkeypatch):
    """Calls of `distant_points`, which finds FOUND and HIDDEN."""
    calls = []

    def distant_points(points, views, layers, groups, exposed):
        calls.append((points, views, layers, groups))
        return FOUND, HIDDEN

    monkeypatch.setattr(distant_seeds, "distant_points", distant_points)
    return calls


def started(scene, folder, configure_training, **settings):
    """The model before the first step."""
    config = configure_training("ssa-splatfacto", scene, folder, 2, {"num_downscales": 0, **settings})
    return config.pipeline.setup(device="cpu", test_mode="val", world_size=1, local_rank=0).model


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_a_training_starts_from_distant_points_and_ends_with_a_backdrop(
    tiny_scene, tmp_path, configure_training, train_and_evaluate, stated_points, caplog, strategy: str
) -> None:
    caplog.set_level("INFO")
    plain = started(tiny_scene, tmp_path, configure_training, overlay="on", strategy=strategy, distant_seeds=False)
    assert not stated_points
    assert "distant points" not in caplog.text
    model = started(tiny_scene, tmp_path, configure_training, overlay="on", strategy=strategy)
    assert model.num_points == plain.num_points + 2
    assert "starts from 2 distant points" in caplog.text
    torch.testing.assert_close(model.means[-2:].detach().cpu(), FOUND.positions)
    assert model.opacities[-1].item() == pytest.approx(model.opacities[0].item())
    [(points, views, layers, groups)] = stated_points
    assert len(points) == plain.num_points
    assert len(views) == len(layers) == 12
    assert groups == [0] * 12
    assert [tuple(layer.shape) for layer in layers[0]] == [(48, 64, 1), (48, 64, 3)]

    settings = {"num_downscales": 0, "overlay": "on", "strategy": strategy}
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path / "run", 3, settings)
    _, pipeline, path = train_and_evaluate(config)
    trained = pipeline.model
    assert trained.num_points == plain.num_points + 3, "too few steps for a refinement"
    torch.testing.assert_close(trained.means[-1].detach().cpu(), HIDDEN.positions[0])
    assert trained.opacities[-1].sigmoid().item() == pytest.approx(0.99)
    assert trained.scales[-1].tolist() == pytest.approx([math.log(HIDDEN.spacing)] * 3)
    torch.testing.assert_close(trained.colors[-1].detach().cpu(), HIDDEN.colors[0])

    # A training that goes on has them already.
    longer = configure_training("ssa-splatfacto", tiny_scene, tmp_path / "longer", 6, settings)
    longer.load_dir = path.parent / "nerfstudio_models"
    _, pipeline, _ = train_and_evaluate(longer)
    assert pipeline.model.num_points == trained.num_points
    assert all(torch.isfinite(values).all() for values in pipeline.model.gauss_params.values())


def test_a_run_that_was_stopped_ends_with_its_backdrop(
    tiny_scene, tmp_path, configure_training, train_and_evaluate, stated_points
) -> None:
    settings = {"num_downscales": 0, "overlay": "on"}
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path, 3, settings)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    before = trainer.pipeline.model.num_points
    trainer.save_checkpoint(0)
    resumed = configure_training("ssa-splatfacto", tiny_scene, tmp_path / "resumed", 3, settings)
    resumed.load_dir = trainer.checkpoint_dir
    _, pipeline, _ = train_and_evaluate(resumed)
    assert len(stated_points) == 1
    assert pipeline.model.num_points == before + 1
    torch.testing.assert_close(pipeline.model.means[-1].detach().cpu(), HIDDEN.positions[0])


@pytest.mark.parametrize("settings", [{"overlay": "off"}, {"overlay": "on", "overlay_start": "statistics"}])
def test_a_training_without_an_overlay_or_by_the_papers_rule_has_none(
    tiny_scene, tmp_path, configure_training, stated_points, settings
) -> None:
    started(tiny_scene, tmp_path, configure_training, **settings)
    assert not stated_points
