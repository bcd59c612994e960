"""The overlay: what it starts from, how it is drawn at every scale, and what a checkpoint keeps of it."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nerfstudio.models.splatfacto import resize_image
from torch import Tensor

from ssa_nerfstudio.evidence.detection import static_area
from ssa_nerfstudio.evidence.initialization import initialize
from ssa_nerfstudio.evidence.static_area import StaticArea
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate
from ssa_nerfstudio.overlay.compositing import clipped, composite
from ssa_nerfstudio.overlay.layer import GivenOverlay, ScreenSpaceOverlay


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def randomised(height: int, width: int, resolution: int = 1) -> ScreenSpaceOverlay:
    """An overlay whose parameters are random."""
    overlay = ScreenSpaceOverlay(height, width, resolution)
    generator = torch.Generator().manual_seed(height * width)
    with torch.no_grad():
        for parameter in overlay.parameters():
            parameter.copy_(2 * torch.randn(parameter.shape, generator=generator))
    return overlay


def capture(height: int, width: int, views: int = 12) -> tuple[np.ndarray, ImageStatistics]:
    """Photos [V, H, W, 3] whose noise grows from left (none) to right, and their statistics."""
    generator = np.random.default_rng(0)
    noise = generator.normal(size=(views, height, width, 3)) * np.linspace(0, 90, width)[:, None]
    base = generator.integers(30, 220, (height, width, 3))
    photos = np.clip(base + noise, 0, 255).astype(np.uint8)
    return photos, accumulate((torch.from_numpy(photo), None) for photo in photos)


def test_a_new_overlay_has_the_constant_start_of_the_paper() -> None:
    overlay = ScreenSpaceOverlay(5, 7)
    torch.testing.assert_close(overlay.color(), torch.full((5, 7, 3), 0.5))
    torch.testing.assert_close(overlay.matte(), torch.full((5, 7, 1), 0.1))
    assert (overlay.evidence == 1).all()


def test_color_starts_at_the_mean_and_the_matte_at_exp_of_minus_the_deviation_over_0_05() -> None:
    photos, statistics = capture(9, 13)
    overlay = ScreenSpaceOverlay(9, 13)
    initialize(overlay, statistics)
    values = photos / 255
    mean = np.clip(values.mean(axis=0), 1 / 510, 1 - 1 / 510)
    sigma = values.std(axis=0).max(axis=-1, keepdims=True)
    matte = np.clip(np.exp(-sigma / 0.05), 0.01, 0.99)
    np.testing.assert_allclose(overlay.color().detach().numpy(), mean, atol=1e-6)
    np.testing.assert_allclose(overlay.matte().detach().numpy(), matte, atol=1e-6)
    assert (matte == 0.99).any(), "no pixel is clamped from above"
    assert (matte == 0.01).any(), "no pixel is clamped from below"
    assert ((matte > 0.02) & (matte < 0.98)).any()


@pytest.mark.parametrize("resolution", [1, 2])
def test_by_default_only_what_static_edges_enclose_starts_opaque(resolution: int) -> None:
    """A plain board below, a plain sky above: the views agree on both, but the sky's edge moves."""
    rng = np.random.default_rng(3)
    photos = rng.integers(0, 256, (20, 48, 64, 3), dtype=np.uint8)
    for photo in photos:
        photo[: 12 + rng.integers(0, 6)] = (120, 160, 220)
        photo[36:] = (40, 30, 20)
    statistics = accumulate((torch.from_numpy(photo), None) for photo in photos)
    overlay = ScreenSpaceOverlay(48, 64, resolution)
    initialize(overlay, statistics, static_area(statistics))
    matte, evidence = (t.detach().repeat_interleave(resolution, 0) for t in (overlay.matte(), overlay.evidence))
    torch.testing.assert_close(matte[38:], torch.full_like(matte[38:], 0.99))
    torch.testing.assert_close(matte[:12], torch.full_like(matte[:12], 0.01))
    assert (evidence[38:] == 0).all()
    assert (evidence[:12] == 1).all()
    initialize(overlay, statistics)
    assert (overlay.matte() > 0.98).double().mean() > 0.45


def test_black_white_and_constant_pixels_start_with_finite_logits() -> None:
    photo = torch.zeros(4, 6, 3, dtype=torch.uint8)
    photo[:, 3:] = 255
    overlay = ScreenSpaceOverlay(4, 6)
    initialize(overlay, accumulate((photo, None) for _ in range(3)))
    assert all(parameter.isfinite().all() for parameter in overlay.parameters())
    torch.testing.assert_close(overlay.matte(), torch.full((4, 6, 1), 0.99))
    assert (overlay.color()[:, :3] < 0.0021).all()
    assert (overlay.color()[:, 3:] > 0.9979).all()


@pytest.mark.parametrize("resolution", [1, 2])
def test_pixels_that_no_two_views_show_start_transparent_with_their_mean_color(resolution: int) -> None:
    photo = torch.full((4, 4, 3), 51, dtype=torch.uint8)
    once, never = torch.ones(4, 4, dtype=torch.bool), torch.ones(4, 4, dtype=torch.bool)
    once[:2] = False
    never[:, :2] = False
    overlay = ScreenSpaceOverlay(4, 4, resolution)
    initialize(overlay, accumulate([(photo, never), (photo, never & once)]))
    color, matte = (t.detach().repeat_interleave(resolution, 0).repeat_interleave(resolution, 1) for t in (
        overlay.color(), overlay.matte()
    ))  # fmt: skip
    torch.testing.assert_close(color[:, :2], torch.full((4, 2, 3), 0.5))  # nobody knows
    torch.testing.assert_close(color[:, 2:], torch.full((4, 2, 3), 0.2))
    torch.testing.assert_close(matte[:, :2], torch.full((4, 2, 1), 0.01))
    torch.testing.assert_close(matte[:2], torch.full((2, 4, 1), 0.01))
    torch.testing.assert_close(matte[2:, 2:], torch.full((2, 2, 1), 0.99))


def test_a_start_of_coarser_resolution_averages_the_premultiplied_colors() -> None:
    photos, statistics = capture(8, 12)
    overlay = ScreenSpaceOverlay(8, 12, 2)
    initialize(overlay, statistics)
    values = photos / 255
    alpha = np.exp(-values.std(axis=0).max(axis=-1, keepdims=True) / 0.05)
    blocks = np.concatenate([alpha, alpha * values.mean(axis=0)], axis=-1).reshape(4, 2, 6, 2, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(overlay.matte().detach().numpy(), blocks[..., :1].clip(0.01, 0.99), atol=1e-6)
    color = (blocks[..., 1:] / blocks[..., :1]).clip(1 / 510, 1 - 1 / 510)
    np.testing.assert_allclose(overlay.color().detach().numpy(), color, atol=1e-6)


@pytest.mark.parametrize("resolution", [2, 4])
def test_the_rows_that_fill_no_block_start_from_the_pixels_that_there_are(resolution: int) -> None:
    photo = torch.zeros(9, 7, 3, dtype=torch.uint8)
    photo[8:], photo[:, 6:] = 204, 204
    overlay = ScreenSpaceOverlay(9, 7, resolution)
    initialize(overlay, accumulate((photo, None) for _ in range(2)))
    assert overlay.color().shape[:2] == (-(-9 // resolution), -(-7 // resolution))
    torch.testing.assert_close(overlay.color()[-1], torch.full_like(overlay.color()[-1], 0.8))
    torch.testing.assert_close(overlay.matte(), torch.full_like(overlay.matte(), 0.99))


def test_statistics_of_another_frame_are_refused() -> None:
    _, statistics = capture(8, 12)
    with pytest.raises(ValueError, match=r"statistics of a frame \(8, 12\) for an overlay of \(12, 8\)"):
        initialize(ScreenSpaceOverlay(12, 8), statistics)


def area_of(opaque: np.ndarray, near: np.ndarray, matte: float, difference: float, light: bool = False) -> StaticArea:
    """An area that is opaque here, and has a matte and a difference in color near its edges."""
    here = torch.from_numpy(near)
    return StaticArea(
        inside=here,
        near=here,
        opaque=torch.from_numpy(opaque),
        matte=matte * here.float(),
        difference=difference * here.float()[..., None].expand(-1, -1, 3),
        adds_light=light,
    )


def halves(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Opaque on the left quarter, an artifact on the left half."""
    opaque, near = np.zeros((2, height, width), bool)
    opaque[:, : width // 4], near[:, : width // 2] = True, True
    return opaque, near


def test_evidence_is_the_deviation_over_its_70th_percentile_where_opaque_and_one_minus_the_matte_elsewhere() -> None:
    photos, statistics = capture(10, 20)
    overlay = ScreenSpaceOverlay(10, 20)
    opaque, near = halves(10, 20)
    initialize(overlay, statistics, area_of(opaque, near, matte=0.3, difference=0.1))
    sigma = (photos / 255).std(axis=0).max(axis=-1)
    reference = np.sort(sigma.ravel())[140 - 1]  # the 140th of 200
    expected = np.minimum(np.where(opaque, np.minimum(1, sigma / reference), 1), np.where(near, 0.7, 1))
    np.testing.assert_allclose(overlay.evidence[..., 0].numpy(), expected, atol=1e-6)
    assert (overlay.evidence[1:-1, 0] == 0).all(), "pixels whose views agree are spared"
    assert "evidence" not in dict(overlay.named_parameters())


@pytest.mark.parametrize("resolution", [1, 2])
def test_what_the_edges_imply_is_what_the_layers_start_from(resolution: int) -> None:
    """Mean = T scene + B: with an estimated matte and difference, the scene behind comes out as estimated, too."""
    photos, statistics = capture(12, 16)
    mean = photos.mean(axis=0) / 255
    opaque, near = halves(12, 16)
    overlay = ScreenSpaceOverlay(12, 16, resolution)
    initialize(overlay, statistics, area_of(opaque, near, matte=0.3, difference=0.05))
    transmittance, addition = (layer.detach().numpy() for layer in overlay.layers(resolution))
    blocks = mean.reshape(12 // resolution, resolution, 16 // resolution, resolution, 3).mean(axis=(1, 3))
    faint = np.zeros(transmittance.shape[:2], bool)
    faint[:, 4 // resolution : 8 // resolution] = True
    np.testing.assert_allclose(transmittance[faint], 0.7, atol=1e-6)
    np.testing.assert_allclose((blocks - addition)[faint] / 0.7, (blocks - 0.05)[faint], atol=0.01)
    np.testing.assert_allclose(transmittance[:, 8 // resolution :], 0.99, atol=1e-6)
    assert (overlay.near[..., 0].numpy() == np.repeat([[1, 0]], 8 // resolution, axis=1)).all()


def test_where_edges_imply_nothing_the_overlay_starts_in_the_color_that_it_has_elsewhere() -> None:
    """A dark drop and a bright one, of the same color; a third was missed."""
    color, scene = torch.tensor([0.6, 0.3, 0.1]), torch.tensor([0.3, 0.7]).repeat_interleave(4)[:, None, None]
    photos = [(255 * scene.expand(8, 16, 3)).to(torch.uint8)] * 2
    matte = torch.zeros(8, 16)
    matte[1:3, 2:6], matte[5:7, 9:14] = 0.2, 0.3
    statistics = accumulate((photo, None) for photo in photos)
    mean = statistics.mean().float()
    clean = (mean - matte[..., None] * color) / (1 - matte[..., None])  # so that the photos show the drops
    area = StaticArea(
        inside=matte > 0,
        near=torch.ones(8, 16, dtype=torch.bool),
        opaque=torch.zeros(8, 16, dtype=torch.bool),
        matte=matte,
        difference=mean - clean,
        adds_light=False,
    )
    overlay = ScreenSpaceOverlay(8, 16)
    initialize(overlay, statistics, area)
    torch.testing.assert_close(overlay.color(), color.expand(8, 16, 3), atol=1e-3, rtol=0)
    torch.testing.assert_close(overlay.matte()[..., 0], matte.clamp_min(0.1), atol=1e-3, rtol=0)


def test_what_is_opaque_or_only_colored_keeps_its_own_color_and_what_is_opaque_lends_it_to_nobody() -> None:
    """From left to right: an opaque board, a drop, an edge too faint for a matte, nothing."""
    _, statistics = capture(6, 12)
    mean = statistics.mean().float()
    opaque, matte, difference = torch.zeros(6, 12, dtype=torch.bool), torch.zeros(6, 12), torch.zeros(6, 12, 3)
    opaque[:, :3] = True
    matte[:, :6] = 0.5
    difference[:, 3:9] = 0.05
    everywhere = torch.ones(6, 12, dtype=torch.bool)
    overlay = ScreenSpaceOverlay(6, 12)
    initialize(overlay, statistics, StaticArea(everywhere, everywhere, opaque, matte, difference, adds_light=False))
    color = overlay.color().detach()
    implied = (mean - (1 - torch.clamp(matte, min=0.1)[..., None]) * (mean - difference).clamp(0, 1)) / torch.clamp(
        matte, min=0.1
    )[..., None]
    torch.testing.assert_close(color[:, :3], mean[:, :3].clamp(1 / 510, 1 - 1 / 510), atol=1e-3, rtol=0)
    torch.testing.assert_close(color[:, 3:9], implied[:, 3:9].clamp(1 / 510, 1 - 1 / 510), atol=1e-3, rtol=0)
    usual = implied[:, 3:6].clamp(0, 1).mean(dim=(0, 1))
    torch.testing.assert_close(color[:, 9:], usual.expand(6, 3, 3), atol=1e-3, rtol=0)


@pytest.mark.parametrize("resolution", [1, 2])
def test_what_adds_light_starts_from_the_difference_and_hides_only_where_it_is_opaque(resolution: int) -> None:
    _, statistics = capture(12, 16)
    opaque, near = halves(12, 16)
    overlay = ScreenSpaceOverlay(12, 16, resolution, adds_light=True)
    initialize(overlay, statistics, area_of(opaque, near, matte=0.3, difference=0.2, light=True))
    matte, light = overlay.matte().detach(), overlay.color().detach()
    quarter = 4 // resolution
    torch.testing.assert_close(light[:, quarter : 2 * quarter], torch.full_like(light[:, quarter : 2 * quarter], 0.2))
    torch.testing.assert_close(light[:, 2 * quarter :], torch.full_like(light[:, 2 * quarter :], 0.01))
    torch.testing.assert_close(matte[:, quarter:], torch.full_like(matte[:, quarter:], 0.01))
    assert matte[1:-1, 0].min() > 0.7
    assert (overlay.evidence[:, quarter:] == 1).all()


def test_where_most_pixels_never_change_there_is_no_scale_and_evidence_stays_one() -> None:
    photos = np.full((4, 5, 5, 3), 80, np.uint8)
    photos[1, 2, 2] = 90
    overlay = ScreenSpaceOverlay(5, 5)
    initialize(overlay, accumulate((torch.from_numpy(photo), None) for photo in photos))
    assert (overlay.evidence == 1).all()


@pytest.mark.parametrize("reduction", [1, 2, 4])
@pytest.mark.parametrize(("height", "width"), [(16, 24), (17, 23), (18, 21), (5, 4)])
def test_layers_are_reduced_as_nerfstudio_reduces_the_photos(height: int, width: int, reduction: int) -> None:
    overlay = randomised(height, width)
    transmittance, addition = overlay.layers(reduction)
    color, matte = overlay.color(), overlay.matte()
    full = torch.cat([1 - matte, matte * color], dim=-1)
    expected = full if reduction == 1 else resize_image(full, reduction)
    torch.testing.assert_close(torch.cat([transmittance, addition], dim=-1), expected)


def test_compositing_at_half_size_is_reducing_the_composite_where_the_render_is_smooth() -> None:
    overlay = randomised(12, 16)
    coarse = random(6, 8, 3)
    fine = coarse.repeat_interleave(2, 0).repeat_interleave(2, 1)
    torch.testing.assert_close(
        composite(coarse, *overlay.layers(2)), resize_image(composite(fine, *overlay.layers()), 2)
    )


@pytest.mark.parametrize("reduction", [1, 2, 4])
@pytest.mark.parametrize("resolution", [1, 2, 4])
@pytest.mark.parametrize(("height", "width"), [(16, 24), (17, 23), (13, 30)])
def test_an_overlay_of_any_resolution_is_drawn_at_the_size_of_the_photos(
    height: int, width: int, resolution: int, reduction: int
) -> None:
    overlay = ScreenSpaceOverlay(height, width, resolution)
    assert overlay.matte().shape == (-(-height // resolution), -(-width // resolution), 1)
    assert overlay.evidence.shape == overlay.matte().shape
    transmittance, addition = overlay.layers(reduction)
    assert transmittance.shape == (height // reduction, width // reduction, 1)
    assert addition.shape == (height // reduction, width // reduction, 3)
    torch.testing.assert_close(transmittance, torch.full_like(transmittance, 0.9))
    torch.testing.assert_close(addition, torch.full_like(addition, 0.05))


@settings(max_examples=40, deadline=None)
@given(clean=st.floats(0, 1), color=st.floats(0.01, 0.99), alpha=st.floats(0.01, 0.99))
def test_compositing_is_the_equation_of_the_paper(clean: float, color: float, alpha: float) -> None:
    overlay = ScreenSpaceOverlay(1, 1).double()
    with torch.no_grad():
        overlay.color_logits.fill_(math.log(color / (1 - color)))
        overlay.alpha_logits.fill_(math.log(alpha / (1 - alpha)))
    drawn = composite(torch.full((1, 1, 3), clean, dtype=torch.float64), *overlay.layers())
    torch.testing.assert_close(drawn, torch.full_like(drawn, alpha * color + (1 - alpha) * clean))


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("resolution", [1, 2])
@pytest.mark.parametrize("reduction", [1, 2])
def test_gradients_of_compositing_are_those_of_finite_differences(
    reduction: int, resolution: int, adds_light: bool
) -> None:
    overlay = randomised(5, 6, resolution).double()
    overlay.adds_light = adds_light
    clean = random(5 // reduction, 6 // reduction, 3, dtype=torch.float64).requires_grad_()

    def drawn(clean: Tensor, *_: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return composite(clean, *overlay.layers(reduction)), overlay.opacity(), overlay.color()

    assert torch.autograd.gradcheck(drawn, (clean, *overlay.parameters()))


def test_what_adds_light_need_not_hide_and_weighs_what_it_adds() -> None:
    overlay = ScreenSpaceOverlay(2, 3, adds_light=True).double()
    with torch.no_grad():
        overlay.alpha_logits.fill_(-12.0)
        overlay.color_logits.copy_(torch.tensor([0.3, 0.2, 0.1]).logit().expand(2, 3, 3))
    clean = random(2, 3, 3, dtype=torch.float64)
    added = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64).expand(2, 3, 3)
    torch.testing.assert_close(composite(clean, *overlay.layers()), clean + added, rtol=0, atol=1e-5)
    torch.testing.assert_close(overlay.opacity(), added[..., :1])


def test_a_prediction_beyond_white_is_recorded_as_white_and_brought_back() -> None:
    picture = torch.tensor([-0.5, 0.2, 1.5], requires_grad=True)
    recorded = clipped(picture)
    assert recorded.tolist() == pytest.approx([0.0, 0.2, 1.0])
    (recorded - 0.9).abs().sum().backward()
    assert picture.grad is not None
    assert picture.grad.tolist() == [-1.0, -1.0, 1.0]


@pytest.mark.parametrize("adds_light", [False, True])
def test_while_it_waits_for_the_scene_nothing_is_learned_far_from_static_edges(adds_light: bool) -> None:
    overlay = randomised(4, 6)
    overlay.adds_light = adds_light
    overlay.near[:, 3:] = 0
    adam = torch.optim.Adam(overlay.parameters(), lr=0.1, eps=1e-15)
    start = torch.cat([parameter.detach().clone() for parameter in overlay.parameters()], dim=-1)
    for waiting in (True, True, False):
        overlay.wait_for_the_scene(waiting)
        loss = composite(random(4, 6, 3), *overlay.layers()).mean() + overlay.opacity().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        overlay.take_back()
        moved = (torch.cat(list(overlay.parameters()), dim=-1) - start).abs()
        assert moved[:, :3].all()
        assert moved[:, 3:].all() if not waiting else not moved[:, 3:].any()
    assert moved[:, 3:].max() < 0.11, "the first step after a wait is as large as any"


def test_the_scene_gets_the_share_of_the_gradient_that_the_matte_lets_through() -> None:
    overlay = randomised(4, 5)
    clean = random(4, 5, 3).requires_grad_()
    composite(clean, *overlay.layers()).sum().backward()
    torch.testing.assert_close(clean.grad, (1 - overlay.matte()).expand(4, 5, 3))


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("resolution", [1, 2])
def test_a_state_dict_brings_the_overlay_back(resolution: int, adds_light: bool) -> None:
    _, statistics = capture(9, 13)
    overlay = ScreenSpaceOverlay(9, 13, resolution, adds_light)
    initialize(overlay, statistics)
    file = io.BytesIO()
    torch.save(overlay.state_dict(), file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    again = ScreenSpaceOverlay(*state["frame"].tolist())
    again.load_state_dict(state)
    assert (again.height, again.width, again.resolution, again.adds_light) == (9, 13, resolution, adds_light)
    assert torch.equal(again.evidence, overlay.evidence)
    for reduction in (1, 2, 4):
        for found, expected in zip(again.layers(reduction), overlay.layers(reduction), strict=True):
            assert torch.equal(found, expected)


def test_a_state_dict_of_another_frame_is_refused() -> None:
    with pytest.raises(RuntimeError, match="size mismatch"):
        ScreenSpaceOverlay(9, 13).load_state_dict(ScreenSpaceOverlay(13, 9).state_dict())


def test_a_given_overlay_is_drawn_exactly_and_reduced_like_the_photos() -> None:
    transmittance, addition = random(11, 14, 3, seed=1), 0.7 * random(11, 14, 3, seed=2)
    overlay = GivenOverlay(transmittance, addition)
    assert (overlay.height, overlay.width) == (11, 14)
    found = overlay.layers()
    assert torch.equal(found[0], transmittance)
    assert torch.equal(found[1], addition)
    for reduction in (2, 4):
        found = overlay.layers(reduction)
        torch.testing.assert_close(found[0], resize_image(transmittance, reduction))
        torch.testing.assert_close(found[1], resize_image(addition, reduction))
    assert not list(overlay.parameters()), "what is given is not learned"


def test_a_given_overlay_survives_its_state_dict() -> None:
    overlay = GivenOverlay(random(6, 8, 3), random(6, 8, 3, seed=1))
    again = GivenOverlay(torch.ones(6, 8, 3), torch.zeros(6, 8, 3))
    again.load_state_dict(overlay.state_dict())
    assert torch.equal(again.layers()[0], overlay.layers()[0])
    assert torch.equal(again.layers()[1], overlay.layers()[1])


clear, dark = torch.ones(4, 5, 3), torch.zeros(4, 5, 3)


@pytest.mark.parametrize(
    ("transmittance", "addition", "message"),
    [
        (clear[..., :1], dark, "must both be"),
        (clear[..., :1], dark[..., :1], "must both be"),
        (clear[0], dark[0], "must both be"),
        (clear, dark[:3], r"they are \(4, 5, 3\) and \(3, 5, 3\)"),
        (clear.clone().index_fill_(0, torch.tensor(1), float("nan")), dark, "not finite"),
        (clear, dark.clone().index_fill_(0, torch.tensor(1), float("inf")), "not finite"),
        (1.001 * clear, dark, "T must lie in"),
        (clear - 1.001, dark, "T must lie in"),
    ],
)
def test_an_impossible_given_overlay_is_refused(transmittance: Tensor, addition: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GivenOverlay(transmittance, addition)
