"""Upsampling along the edges of a guide."""

from __future__ import annotations

import pytest
import torch

from ssa_nerfstudio.evidence.guided_upsampling import enlarged, local_mean, reduced, upsample


@pytest.mark.parametrize("size", [(24, 32), (27, 34)])
def test_layers_that_are_a_function_of_the_guide_get_its_edges(size: tuple[int, int]) -> None:
    guide = torch.full((*size, 3), 0.2)
    guide[:, 14:, 0], guide[9:, :, 1] = 0.8, 0.6
    layers = torch.cat([1 - guide[..., :1], 0.5 * guide[..., 1:2] + 0.1], dim=-1)
    found = upsample(reduced(layers, 4), guide, 4)
    assert found.shape == layers.shape
    assert (found - layers).abs().max() < 0.03
    linear = torch.nn.functional.interpolate(reduced(layers, 4).permute(2, 0, 1)[None], size=size, mode="bilinear")
    assert (linear[0].permute(1, 2, 0) - layers).abs().max() > 0.2


def test_a_guide_without_contrast_leaves_smooth_layers_smooth() -> None:
    layers = torch.linspace(0, 1, 8)[None, :, None].expand(6, 8, 1)
    found = upsample(layers, torch.full((18, 24, 2), 0.4), 3)
    assert (found.diff(dim=1) >= -1e-5).all()
    assert found.std(dim=0).max() < 1e-5
    assert torch.equal(upsample(layers, torch.zeros(6, 8, 2), 1), layers)


def test_local_means_are_means_of_what_is_in_the_frame() -> None:
    values = torch.arange(12.0).reshape(3, 4, 1)
    assert float(local_mean(values, 1)[0, 0]) == pytest.approx((0 + 1 + 4 + 5) / 4)
    assert float(local_mean(values, 9)[2, 3]) == pytest.approx(5.5)


def test_enlarging_keeps_places_and_repeats_the_last_pixels() -> None:
    """A ramp over pixel centers stays one, in every one of its further dimensions."""
    values = torch.arange(5.0)[None, :, None, None].expand(3, 5, 2, 2) * torch.tensor([[1.0, 2.0], [3.0, -1.0]])
    found = enlarged(values, 7, 12, 2)
    assert found.shape == (7, 12, 2, 2)
    places = ((torch.arange(12.0) + 0.5) / 2 - 0.5).clamp(0, 4)
    torch.testing.assert_close(found[3, :, 1, 0], 3 * places)
    torch.testing.assert_close(found[6, :, 0, 1], 2 * places)
    assert torch.equal(found[:, 11], found[:, 9])


def test_reducing_averages_squares_and_drops_the_rest() -> None:
    image = torch.arange(7.0 * 8 * 2).reshape(7, 8, 2)
    found = reduced(image, 3)
    assert found.shape == (2, 2, 2)
    torch.testing.assert_close(found[1, 0], image[3:6, :3].mean(dim=(0, 1)))


def test_local_means_keep_further_dimensions_apart() -> None:
    values = torch.rand(5, 6, 2, 3, generator=torch.Generator().manual_seed(0))
    found = local_mean(values, 2)
    torch.testing.assert_close(found[2, 3, 1, 2], values[:, 1:6, 1, 2].mean())
    torch.testing.assert_close(found[0, 0], values[:3, :3].mean(dim=(0, 1)))
