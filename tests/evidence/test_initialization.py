"""What an overlay starts from: the paper's rule, and what the static edges of the photos imply."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssa_nerfstudio.evidence.detection import static_area
from ssa_nerfstudio.evidence.initialization import initialize
from ssa_nerfstudio.evidence.static_area import StaticArea
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay


def capture(height: int, width: int, views: int = 12) -> tuple[np.ndarray, ImageStatistics]:
    """Photos [V, H, W, 3] whose noise grows from left (none) to right, and their statistics."""
    generator = np.random.default_rng(0)
    noise = generator.normal(size=(views, height, width, 3)) * np.linspace(0, 90, width)[:, None]
    base = generator.integers(30, 220, (height, width, 3))
    photos = np.clip(base + noise, 0, 255).astype(np.uint8)
    return photos, accumulate((torch.from_numpy(photo), None) for photo in photos)


def test_initial_color_is_the_mean_and_initial_matte_exp_of_minus_sigma_over_0_05() -> None:
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
def test_only_areas_that_static_edges_enclose_are_initialized_opaque(resolution: int) -> None:
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


def test_black_white_and_constant_pixels_have_finite_initial_logits() -> None:
    photo = torch.zeros(4, 6, 3, dtype=torch.uint8)
    photo[:, 3:] = 255
    overlay = ScreenSpaceOverlay(4, 6)
    initialize(overlay, accumulate((photo, None) for _ in range(3)))
    assert all(parameter.isfinite().all() for parameter in overlay.parameters())
    torch.testing.assert_close(overlay.matte(), torch.full((4, 6, 1), 0.99))
    assert (overlay.color()[:, :3] < 0.0021).all()
    assert (overlay.color()[:, 3:] > 0.9979).all()


@pytest.mark.parametrize("resolution", [1, 2])
def test_pixels_that_no_two_views_show_are_initialized_transparent_with_their_mean_color(resolution: int) -> None:
    photo = torch.full((4, 4, 3), 51, dtype=torch.uint8)
    once, never = torch.ones(4, 4, dtype=torch.bool), torch.ones(4, 4, dtype=torch.bool)
    once[:2] = False
    never[:, :2] = False
    overlay = ScreenSpaceOverlay(4, 4, resolution)
    initialize(overlay, accumulate([(photo, never), (photo, never & once)]))
    color, matte = (t.detach().repeat_interleave(resolution, 0).repeat_interleave(resolution, 1) for t in (
        overlay.color(), overlay.matte()
    ))  # fmt: skip
    torch.testing.assert_close(color[:, :2], torch.full((4, 2, 3), 0.5))  # no view shows it
    torch.testing.assert_close(color[:, 2:], torch.full((4, 2, 3), 0.2))
    torch.testing.assert_close(matte[:, :2], torch.full((4, 2, 1), 0.01))
    torch.testing.assert_close(matte[:2], torch.full((2, 4, 1), 0.01))
    torch.testing.assert_close(matte[2:, 2:], torch.full((2, 2, 1), 0.99))


def test_a_coarser_overlay_averages_premultiplied_colors() -> None:
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
def test_partial_blocks_are_initialized_from_the_pixels_that_they_have(resolution: int) -> None:
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
def test_initial_layers_are_those_estimated_from_the_edges(resolution: int) -> None:
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


def test_without_an_estimate_the_initial_color_is_the_mean_of_the_estimated_ones() -> None:
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


def test_opaque_and_estimated_pixels_keep_their_color_and_opaque_ones_do_not_enter_the_mean() -> None:
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
def test_additive_light_is_initialized_from_the_difference_and_hides_only_where_opaque(resolution: int) -> None:
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


def test_evidence_is_one_where_most_pixels_never_change() -> None:
    photos = np.full((4, 5, 5, 3), 80, np.uint8)
    photos[1, 2, 2] = 90
    overlay = ScreenSpaceOverlay(5, 5)
    initialize(overlay, accumulate((torch.from_numpy(photo), None) for photo in photos))
    assert (overlay.evidence == 1).all()
