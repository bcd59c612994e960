"""SpotLessSplats: its features, its network and its segments, and what they remove."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F

from baselines.training import train
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.baselines import dense_features, robustnerf, spotless


def test_the_network_is_one_that_reads_upsampled_features_and_positions():
    torch.manual_seed(0)
    network = spotless.InlierNetwork(7)
    grid, height, width = torch.randn(7, 5, 6), 20, 31
    features = F.interpolate(grid[None], size=(height, width), mode="bilinear")[0].permute(1, 2, 0)
    y, x = torch.linspace(0, 1, height), torch.linspace(0, 1, width)
    octaves = torch.pi * 2.0 ** torch.arange(20)
    encoded = [torch.cat([torch.sin(p[:, None] * octaves), torch.cos(p[:, None] * octaves)], -1) for p in (y, x)]
    rows, columns = encoded[0][:, None].expand(-1, width, -1), encoded[1].expand(height, -1, -1)
    first = torch.cat([layer.weight for layer in (network.by_feature, network.by_row, network.by_column)], dim=1)
    hidden = torch.relu(torch.cat([features, rows, columns], dim=-1) @ first.T + network.by_feature.bias)
    expected = torch.sigmoid(hidden @ network.last.weight.T + network.last.bias)
    torch.testing.assert_close(network(grid, height, width), expected, atol=1e-5, rtol=1e-4)


def test_the_networks_loss_is_zero_between_the_bounds_and_has_its_gradient():
    probability = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64, requires_grad=True)
    least, most = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 1.0])
    assert float(spotless.bounds_loss(probability, least, most).detach()) == pytest.approx((0.2 + 0.0 + 0.1) / 3)
    assert torch.autograd.gradcheck(lambda p: spotless.bounds_loss(p, least, most), (probability,))


def test_the_regularizer_pulls_the_largest_weight_of_each_layer():
    network = spotless.InlierNetwork(3)
    network.by_row.weight.data[2, 1] = -3.0
    network.last.weight.data[0, 4] = 2.0
    network.regularizer().backward()
    row, last = network.by_row.weight.grad, network.last.weight.grad
    assert row is not None
    assert last is not None
    assert (float(row[2, 1]), int(row.count_nonzero())) == (-2.0, 1)
    assert (float(last[0, 4]), int(last.count_nonzero())) == (3.0, 1)


def test_a_segment_is_an_inlier_if_more_than_half_of_it_is():
    labels = torch.tensor([[0, 1], [2, 2]])
    inlier = torch.zeros(4, 8, 1)
    inlier[:2, :2] = 1.0  # half of segment 0
    inlier[:2, 4:7] = 1.0  # three quarters of segment 1
    expected = torch.zeros(4, 8, 1)
    expected[:2, 4:] = 1.0
    assert torch.equal(spotless.segment_votes(inlier, labels), expected)


def test_hand_made_features_tell_a_texture_and_a_color_from_the_rest():
    photo = torch.full((60, 80, 3), 0.5)
    photo[10:40, 10:40] = (torch.rand(30, 30, 1, generator=torch.Generator().manual_seed(0)) > 0.5).float()
    photo[20:50, 50:75] = torch.tensor([0.9, 0.1, 0.9])
    (grid,) = dense_features.hand_made([photo])
    assert grid.shape == (107, 38, 50)
    labels = dense_features.ward_clusters(grid, 8)
    assert labels.shape == (38, 50)
    purple = labels[15:29, 34:45]
    assert (purple == purple[0, 0]).float().mean() > 0.9
    outside = torch.cat([labels[:3].flatten(), labels[-3:].flatten()])
    assert not (outside == purple[7, 5]).any()


def test_features_of_stable_diffusion_are_read_through_diffusers(tmp_path, monkeypatch):
    pytest.importorskip("diffusers", reason="pip install '.[diffusion]'")
    from baselines.tiny_diffusion import save_stable_diffusion

    monkeypatch.setattr(dense_features, "SIDE", 128)  # 8 cells of 16 pixels a side
    weights = save_stable_diffusion(tmp_path)
    generator = torch.Generator().manual_seed(0)
    photos = [torch.rand(40, 60, 3, generator=generator) for _ in range(2)]
    first = list(dense_features.diffusion(weights, photos, torch.device("cpu")))
    again = list(dense_features.diffusion(weights, photos, torch.device("cpu")))
    assert [grid.shape for grid in first] == [(8, 8, 8)] * 2
    assert all(torch.equal(*pair) for pair in zip(first, again, strict=True))
    assert not torch.allclose(first[0], first[1])


@pytest.mark.parametrize(("features", "seen"), [("hand-made", (24, 32, 3)), ("weights", (48, 64, 3))])
def test_stable_diffusion_sees_whole_photos_at_whatever_resolution_training_starts(
    capture, tmp_path, monkeypatch, features, seen
):
    shapes = []

    def found(photos):
        for photo in photos:
            assert 0 <= float(photo.min()) < float(photo.max()) <= 1
            shapes.append((*photo.shape,))
            yield torch.zeros(3, 5, 5)

    monkeypatch.setattr(spotless, "require", lambda *_: None)
    monkeypatch.setattr(spotless, "hand_made", found)
    monkeypatch.setattr(spotless, "diffusion", lambda folder, photos, device: found(photos))
    train("spotless-mlp", capture("transient"), tmp_path, 1, features=features, num_downscales=1)
    assert shapes == [seen] * 24


def test_weights_that_cannot_be_read_are_refused_with_what_to_download(tmp_path):
    pytest.importorskip("diffusers", reason="pip install '.[diffusion]'")
    (tmp_path / "model_index.json").write_text("{")
    with pytest.raises(InputError, match="stable-diffusion-2-1, CreativeML") as refusal:
        list(dense_features.diffusion(tmp_path, [torch.rand(8, 8, 3)], torch.device("cpu")))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("method", ["spotless-mlp", "spotless-agg"])
def test_the_loss_is_masked_by_the_network_or_the_segments_and_not_by_residuals_alone(capture, tmp_path, method):
    _, pipeline = train(method, capture("transient"), tmp_path, 3)
    model: Any = pipeline.model
    model.train()
    model.config.stop_split_at = 0  # the histogram stays as it is
    camera, batch = pipeline.datamanager.next_train(0)
    outputs = model.get_outputs(camera)
    residuals = robustnerf.residual(outputs["rgb"], model.target(outputs, batch))
    bounds = [robustnerf.inliers(residuals, model.residuals.quantile(share)) for share in (0.5, 0.9)]
    alone = robustnerf.inliers(residuals, model.residuals.quantile(0.7))
    weights = model.inlier_weights(residuals, batch)
    assert not torch.equal(weights, alone)
    if method == "spotless-agg":
        torch.testing.assert_close(weights, spotless.segment_votes(alone, model._grids[batch["image_idx"]]))
        return
    network = model._network()
    predicted = network(model._grids[batch["image_idx"]], *residuals.shape[:2])
    torch.testing.assert_close(weights, predicted)
    expected = spotless.bounds_loss(predicted, *bounds) + 0.5 * network.regularizer()
    torch.testing.assert_close(model.get_loss_dict(outputs, batch)["inlier_network"], expected)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spotless-mlp", "spotless-agg"])
def test_it_removes_a_transient_distractor_and_learns_from_a_watermark(gain, kept, baked, method):
    assert gain(method, "transient") > 0.7
    assert kept(method, "transient") < 0.3
    assert kept(method, "watermark") > 0.3
    assert baked(method, "transient") < 0.7 * baked("3dgs", "transient")
    assert baked(method, "watermark") > 0.4 * baked("3dgs", "watermark")
