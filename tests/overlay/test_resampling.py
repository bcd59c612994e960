"""Resampling of premultiplied layers: sizes, averages, letterboxes, and inverses."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ssa_nerfstudio.overlay.compositing import composite
from ssa_nerfstudio.overlay.layer import OracleOverlay, ScreenSpaceOverlay, letterboxed_layers
from ssa_nerfstudio.overlay.resampling import (
    box_reduce,
    enlarge,
    letterbox,
    premultiply,
    reduced_size,
    straight_color,
    to_training_scale,
)

sides = st.integers(1, 40)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_reducing_averages_whole_blocks_and_drops_the_rest(factor: int) -> None:
    layer = random(11, 14, 4)
    reduced = box_reduce(layer, factor)
    assert reduced.shape == (11 // factor, 14 // factor, 4)
    for y in range(reduced.shape[0]):
        for x in range(reduced.shape[1]):
            block = layer[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
            torch.testing.assert_close(reduced[y, x], block.mean(dim=(0, 1)))


@settings(max_examples=40, deadline=None)
@given(height=st.integers(4, 30), width=st.integers(4, 30))
def test_reducing_twice_by_two_is_reducing_once_by_four(height: int, width: int) -> None:
    layer = random(height, width, 3)
    torch.testing.assert_close(box_reduce(box_reduce(layer, 2), 2), box_reduce(layer, 4))


def test_enlarging_interpolates_between_pixel_centers_and_keeps_the_corner() -> None:
    ramp = torch.arange(5, dtype=torch.float64)[None, :, None].expand(3, 5, 1)
    enlarged = enlarge(ramp, 2, 6, 9)
    assert enlarged.shape == (6, 9, 1)
    expected = ((torch.arange(9, dtype=torch.float64) + 0.5) / 2 - 0.5).clamp(0, 4)
    torch.testing.assert_close(enlarged[:, :, 0], expected.expand(6, 9))


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(4, 50),
    width=st.integers(4, 50),
    resolution=st.sampled_from([1, 2, 4]),
    reduction=st.sampled_from([1, 2, 4]),
    value=st.floats(0, 1),
)
def test_a_constant_layer_stays_constant_at_any_training_scale(
    height: int, width: int, resolution: int, reduction: int, value: float
) -> None:
    size = reduced_size(height, width, resolution)
    assert size == (-(-height // resolution), -(-width // resolution))
    layer = torch.full((*size, 4), value, dtype=torch.float64)
    scaled = to_training_scale(layer, resolution, reduction, height, width)
    assert scaled.shape == (height // reduction, width // reduction, 4)
    torch.testing.assert_close(scaled, torch.full_like(scaled, value))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 1000), min_alpha=st.sampled_from([1e-3, 0.1, 1.0]))
def test_straight_color_inverts_premultiply(seed: int, min_alpha: float) -> None:
    color, alpha = random(5, 6, 3, seed=seed), min_alpha + (1 - min_alpha) * random(5, 6, 1, seed=seed + 1)
    transmittance, addition = premultiply(color, alpha)
    color_again, alpha_again = straight_color(transmittance, addition)
    torch.testing.assert_close(alpha_again, alpha, rtol=0, atol=1e-14)
    torch.testing.assert_close(color_again, color, rtol=0, atol=1e-12)


def test_premultiply_inverts_straight_color() -> None:
    alpha = random(5, 6, 1)
    alpha[:2] = 0
    transmittance, addition = 1 - alpha, alpha * random(5, 6, 3, seed=1)
    again = premultiply(*straight_color(transmittance, addition))
    torch.testing.assert_close(again[0], transmittance, rtol=0, atol=1e-15)
    torch.testing.assert_close(again[1], addition, rtol=0, atol=1e-15)


def test_where_the_matte_is_zero_the_color_is_black_and_a_colored_transmittance_counts_by_its_mean() -> None:
    color, alpha = straight_color(torch.ones(2, 2, 1), torch.zeros(2, 2, 3))
    assert (color == 0).all()
    assert (alpha == 0).all()
    _, alpha = straight_color(torch.tensor([[[0.1, 0.2, 0.9]]]), torch.zeros(1, 1, 3))
    assert alpha.item() == pytest.approx(0.6)


def test_additive_light_gets_the_smallest_matte_that_carries_it() -> None:
    added = torch.tensor([[[0.3, 0.2, 0.0]]])
    color, alpha = straight_color(torch.ones(1, 1, 1), added)
    assert alpha.item() == pytest.approx(0.3)
    torch.testing.assert_close(alpha * color, added)


@settings(max_examples=80, deadline=None)
@given(height=sides, width=sides, into_height=sides, into_width=sides)
def test_a_letterbox_never_stretches_and_leaves_its_bars_clear(
    height: int, width: int, into_height: int, into_width: int
) -> None:
    layer = torch.full((height, width, 3), 0.25)
    framed = letterbox(layer, into_height, into_width, fill=1.0)
    assert framed.shape == (into_height, into_width, 3)
    filled = framed[..., 0] != 1.0
    rows, columns = filled.any(dim=1), filled.any(dim=0)
    inner_height, inner_width = int(rows.sum()), int(columns.sum())
    assert torch.equal(filled, rows[:, None] & columns[None, :]), "the layer does not fill one rectangle"
    torch.testing.assert_close(framed[filled], torch.full_like(framed[filled], 0.25))
    scale = min(into_height / height, into_width / width)
    assert abs(inner_height - height * scale) <= 0.5 or inner_height == 1
    assert abs(inner_width - width * scale) <= 0.5 or inner_width == 1
    assert inner_height == into_height or inner_width == into_width
    for line, bars in ((rows, into_height - inner_height), (columns, into_width - inner_width)):
        leading = int(line.int().argmax())
        assert leading == bars // 2
        assert line[leading : leading + int(line.sum())].all()


@pytest.mark.parametrize("into", [(30, 100), (100, 30), (200, 260), (35, 35)])
def test_a_disc_stays_round_in_a_letterbox(into: tuple[int, int]) -> None:
    y, x = torch.meshgrid(torch.arange(60) - 29.5, torch.arange(90) - 44.5, indexing="ij")
    disc = ((x**2 + y**2) < 25**2).double()[..., None]
    framed = letterbox(disc, *into, fill=0.0)[..., 0]
    weight = framed / framed.sum()
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in into)
    spread = []
    for position, share in ((rows, weight.sum(dim=1)), (columns, weight.sum(dim=0))):
        middle = (position * share).sum()
        assert middle.item() == pytest.approx((len(position) - 1) / 2, abs=0.51)
        spread.append(((position - middle) ** 2 * share).sum().sqrt().item())
    assert spread[0] == pytest.approx(spread[1], rel=0.03)


def test_a_letterbox_of_the_same_size_is_the_layer_itself() -> None:
    layer = random(7, 9, 3)
    assert letterbox(layer, 7, 9, 1.0) is layer


@pytest.mark.parametrize("kind", ["learned", "given"])
def test_around_a_letterboxed_overlay_the_render_is_unchanged(kind: str) -> None:
    overlay = ScreenSpaceOverlay(20, 30) if kind == "learned" else OracleOverlay(*[0.5 * random(20, 30, 3)] * 2)
    clean = random(50, 40, 3, dtype=torch.float32)
    transmittance, addition = letterboxed_layers(overlay, 50, 40)
    drawn = composite(clean, transmittance, addition)
    assert torch.equal(drawn[:11], clean[:11])  # 27 rows of 40 pixels lie in the middle
    assert torch.equal(drawn[38:], clean[38:])
    assert ((drawn[11:38] - clean[11:38]).abs().amax(dim=-1) > 0).all()


@pytest.mark.parametrize(
    "function",
    [
        lambda layer: box_reduce(layer, 2),
        lambda layer: enlarge(layer, 2, 9, 12),
        lambda layer: letterbox(layer, 9, 20, 1.0),
        lambda layer: letterbox(layer, 4, 3, 0.0),
        lambda layer: to_training_scale(layer, 4, 2, 18, 26),
        lambda layer: to_training_scale(layer, 2, 4, 9, 13),
        lambda layer: premultiply(layer[..., :3], layer[..., 3:]),
        lambda layer: straight_color(layer[..., 3:], 0.1 * layer[..., :3]),
    ],
    ids=["box_reduce", "enlarge", "letterbox", "small letterbox", "finer", "coarser", "stack", "straight"],
)
def test_gradients_of_resampling_are_those_of_finite_differences(function) -> None:
    layer = (0.1 + 0.8 * random(5, 7, 4)).requires_grad_()
    assert torch.autograd.gradcheck(function, (layer,), atol=1e-8)


def test_letterboxing_to_a_smaller_frame_averages_and_does_not_skip() -> None:
    stripes = torch.zeros(8, 32, 1, dtype=torch.float32)
    stripes[:, ::4] = 1.0  # one column in four: without antialiasing, some of them vanish and others double
    framed = letterbox(stripes, 2, 8, 0.0)
    torch.testing.assert_close(framed[:, 1:-1], torch.full((2, 6, 1), 0.25), atol=0.06, rtol=0.0)


def test_straight_color_stays_within_white_where_light_exceeds_it() -> None:
    color, alpha = straight_color(torch.ones(1, 1), torch.tensor([[1.7, 0.5, -0.2]]))
    torch.testing.assert_close(alpha, torch.ones(1, 1))
    torch.testing.assert_close(color, torch.tensor([[1.0, 0.5, 0.0]]))
