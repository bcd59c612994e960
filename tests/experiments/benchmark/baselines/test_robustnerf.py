"""RobustNeRF's filter: its threshold, its mask, and what it removes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from baselines.training import train
from ssa_nerfstudio.experiments.benchmark.baselines import robustnerf


def test_the_threshold_is_the_quantile_of_residuals_in_which_recent_views_count_more():
    histogram = robustnerf.ResidualHistogram()
    assert histogram.quantile(0.7) == 1.0
    generator = torch.Generator().manual_seed(0)
    views = [torch.rand(40, 50, 1, generator=generator) ** (k + 1) for k in range(3)]
    for view in views:
        histogram.add(view)
    weights = np.repeat([robustnerf.DECAY**2, robustnerf.DECAY, 1.0], views[0].numel())
    values = torch.cat([view.flatten() for view in views]).numpy()
    order = np.argsort(values)
    mass = np.cumsum(weights[order]) / weights.sum()
    for share in (0.5, 0.7, 0.9):
        expected = values[order][np.searchsorted(mass, share)]
        assert float(histogram.quantile(share)) == pytest.approx(expected, abs=1.5 / robustnerf.BINS)


def test_a_pixel_among_inliers_is_one_and_a_lone_inlier_stays_one():
    residuals = torch.zeros(7, 7, 1)
    residuals[3, 3] = 1.0  # eight of nine pixels around it are inliers
    assert robustnerf.inliers(residuals, 0.5).all()
    residuals[:] = 1.0
    residuals[3, 3] = 0.0
    assert robustnerf.inliers(residuals, 0.5).sum() == 1
    residuals[:, 4:] = 0.0
    expected = torch.zeros(7, 7, 1)
    expected[:, 4:] = 1.0
    expected[3, 3] = 1.0
    assert torch.equal(robustnerf.inliers(residuals, 0.5), expected)


@pytest.fixture(scope="module")
def short(capture, tmp_path_factory):
    return train("robustnerf", capture("transient"), tmp_path_factory.mktemp("short"), 20, specular_reset_at=21_000)[1]


def test_the_loss_is_the_mean_of_the_inliers_and_moves_them_alone(short):
    model = short.model
    model.train()
    model.step = 10**6  # long after the warm-up
    camera, batch = short.datamanager.next_train(0)
    outputs = model.get_outputs(camera)
    target = model.target(outputs, batch)
    kept = robustnerf.inliers(
        robustnerf.residual(outputs["rgb"], target), model.residuals.quantile(model.config.inlier_quantile)
    )
    assert 0.5 < float(kept.mean()) < 0.95
    shown = outputs["rgb"].detach().requires_grad_()
    loss = model.get_loss_dict({**outputs, "rgb": shown}, batch)["main_loss"]
    assert float(loss.detach()) == pytest.approx(float(((shown - target).abs() * kept).mean().detach()), rel=1e-5)
    (gradient,) = torch.autograd.grad(loss, shown)
    expected = torch.sign(shown - target).detach() * kept / shown.numel()
    torch.testing.assert_close(gradient, expected)


def test_at_first_every_pixel_takes_part(short):
    model = short.model
    model.train()
    model.step = 0
    shown, target = torch.zeros(48, 64, 3), torch.ones(48, 64, 3)
    assert model.loss_mask(shown, target, {}).all()


def test_gaussians_that_no_photo_pulls_are_removed_where_that_is_asked_for(capture, tmp_path):
    def gaussians(name: str, **model) -> int:
        settings = {"densify_grad_thresh": 1.0, **model}
        return train("robustnerf", capture("clean"), tmp_path / name, 160, **settings)[0].gaussians

    without = gaussians("without")
    some = gaussians("some", prune_unused=True)
    assert 0.5 * without < some < without
    assert gaussians("all", prune_unused=True, unused_threshold=1e-7) < some


def test_view_dependent_color_is_reset_once(short):
    # 21,000 of 30,000 steps are 14 of 20.
    assert short.model.config.specular_reset_at == 14
    model = short.model
    rest = model.gauss_params["features_rest"].data
    rest.fill_(0.5)
    rest[:, 0] = -0.5
    model._reset_specular()
    assert float(rest.max()) == pytest.approx(robustnerf.SPECULAR_LIMIT)
    assert (rest[:, 0] == -0.5).all()  # clamped from above alone


@pytest.mark.slow
def test_it_removes_a_transient_distractor(gain, kept, baked):
    assert gain("robustnerf", "transient") > 0.7
    assert kept("robustnerf", "transient") < 0.1
    assert baked("robustnerf", "transient") < 0.3 * baked("3dgs", "transient")


@pytest.mark.slow
def test_it_learns_from_a_watermark(gain, kept, baked):
    assert gain("robustnerf", "watermark") < 0.5
    assert kept("robustnerf", "watermark") > 0.3
    assert baked("robustnerf", "watermark") > 0.4 * baked("3dgs", "watermark")
