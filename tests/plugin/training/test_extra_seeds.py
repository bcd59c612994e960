"""Seeds become Gaussians: those that photos show before the first step, those that none shows after the last.

What they are, tests/evidence/test_distant_points.py and test_gap_points.py test; here it is stated.
"""

from __future__ import annotations

import math

import pytest
import torch

from ssa_nerfstudio.evidence.seeds import Seeds
from ssa_nerfstudio.plugin import extra_seeds

FOUND = Seeds(torch.tensor([[0.0, 0.0, 40.0], [1.0, 0.0, 40.0]]), torch.tensor([[0.2, 0.4, 0.9]] * 2), torch.ones(2))
HIDDEN = Seeds(torch.tensor([[0.0, 1.0, 40.0]]), torch.tensor([[0.9, 0.5, 0.1]]), torch.tensor([1.5]))
GAP = Seeds(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.3, 0.2, 0.1]]), torch.tensor([0.25]))


@pytest.fixture
def stated_points(monkeypatch):
    """Calls of `distant_points`, which finds FOUND, and of `gap_points`, which finds GAP and HIDDEN."""
    calls = []

    def stated(found):
        def points_of(points, photos, *_):
            calls.append((points, photos))
            return found

        return points_of

    monkeypatch.setattr(extra_seeds, "distant_points", stated(FOUND))
    monkeypatch.setattr(extra_seeds, "gap_points", stated((GAP, HIDDEN)))
    return calls


def started(scene, folder, configure_training, **settings):
    """The model before the first step."""
    config = configure_training("ssa-splatfacto", scene, folder, 2, {"num_downscales": 0, **settings})
    return config.pipeline.setup(device="cpu", test_mode="val", world_size=1, local_rank=0).model


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_a_training_starts_from_more_seeds_and_ends_with_a_backdrop(
    tiny_scene, tmp_path, configure_training, train_and_evaluate, stated_points, caplog, strategy: str
) -> None:
    caplog.set_level("INFO")
    settings = {"overlay": "on", "strategy": strategy}
    without = {"distant_seeds": False, "gap_seeds": False}
    plain = started(tiny_scene, tmp_path, configure_training, **settings, **without)
    assert not stated_points
    assert "More Gaussians" not in caplog.text
    for kind, count in (("distant_seeds", 1), ("gap_seeds", 2)):
        model = started(tiny_scene, tmp_path, configure_training, **settings, **{**without, kind: True})
        assert model.num_points == plain.num_points + 3 - count
        assert len(model.artifacts.backdrop) == count - 1
    stated_points.clear()
    model = started(tiny_scene, tmp_path, configure_training, **settings)
    assert model.num_points == plain.num_points + 3
    assert "start from: 2 far away" in caplog.text
    assert "start from: 1 in gaps" in caplog.text
    torch.testing.assert_close(model.means[-3:].detach().cpu(), torch.cat([FOUND.positions, GAP.positions]))
    assert model.scales[-1].tolist() == pytest.approx([math.log(0.25)] * 3)
    assert model.opacities[-1].item() == pytest.approx(model.opacities[0].item())
    [(points, photos), (known, same)] = stated_points
    assert len(points) == plain.num_points
    assert len(known) == plain.num_points + 2, "a distant point is no gap"
    assert same is photos
    assert len(photos) == 12
    assert [photo.group for photo in photos] == [0] * 12

    settings = {"num_downscales": 0, **settings}
    config = configure_training("ssa-splatfacto", tiny_scene, tmp_path / "run", 3, settings)
    _, pipeline, path = train_and_evaluate(config)
    trained = pipeline.model
    assert trained.num_points == plain.num_points + 4, "too few steps for a refinement"
    torch.testing.assert_close(trained.means[-1].detach().cpu(), HIDDEN.positions[0])
    assert trained.opacities[-1].sigmoid().item() == pytest.approx(0.99)
    assert trained.scales[-1].tolist() == pytest.approx([math.log(1.5)] * 3)
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
    assert len(stated_points) == 2
    assert pipeline.model.num_points == before + 1
    torch.testing.assert_close(pipeline.model.means[-1].detach().cpu(), HIDDEN.positions[0])


@pytest.mark.parametrize("settings", [{"overlay": "off"}, {"overlay": "on", "overlay_start": "statistics"}])
def test_a_training_without_an_overlay_or_by_the_papers_rule_has_none(
    tiny_scene, tmp_path, configure_training, stated_points, settings
) -> None:
    started(tiny_scene, tmp_path, configure_training, **settings)
    assert not stated_points
