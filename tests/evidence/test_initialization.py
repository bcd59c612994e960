"""What an overlay starts from: the paper's rule, and layers estimated from the scene's points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssa_nerfstudio.evidence import initialization
from ssa_nerfstudio.evidence.initialization import estimate, guide_of, initialize, initialize_from
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate
from ssa_nerfstudio.evidence.point_samples import PointSamples
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
def test_only_within_a_mask_the_papers_rule_holds(resolution: int) -> None:
    _, statistics = capture(8, 12)
    everywhere, within = ScreenSpaceOverlay(8, 12, resolution), ScreenSpaceOverlay(8, 12, resolution)
    mask = torch.zeros(8, 12, dtype=torch.bool)
    mask[:, :4] = True
    initialize(everywhere, statistics)
    initialize(within, statistics, mask)
    inside = 4 // resolution
    torch.testing.assert_close(within.matte()[:, :inside], everywhere.matte()[:, :inside])
    torch.testing.assert_close(within.color()[:, :inside], everywhere.color()[:, :inside])
    torch.testing.assert_close(within.matte()[:, inside:], torch.full_like(within.matte()[:, inside:], 0.01))
    assert (within.evidence[:, inside:] > 1 - 1e-6).all()
    assert (within.evidence[:, 0] < 0.3).all(), "pixels whose views agree are spared by sparsity"


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


def estimated(height: int, width: int, transmittance: float, addition: tuple[float, ...]) -> LayerEstimate:
    """Layers on the left half, nothing on the right half but a little noise."""
    T, B = torch.full((height, width, 1), 0.97), torch.full((height, width, 3), 0.02)
    T[:, : width // 2], B[:, : width // 2] = transmittance, torch.tensor(addition)
    return LayerEstimate(T, B, torch.ones_like(T), torch.zeros_like(T), torch.tensor(0.03))


@pytest.mark.parametrize("resolution", [1, 2])
@pytest.mark.parametrize(("transmittance", "addition"), [(0.3, (0.5, 0.4, 0.1)), (0.6, (0.0, 0.0, 0.0))])
def test_an_overlay_starts_from_estimated_layers_and_clear_where_they_are_noise(
    resolution: int, transmittance: float, addition: tuple[float, ...]
) -> None:
    _, statistics = capture(12, 16)
    overlay = ScreenSpaceOverlay(12, 16, resolution)
    initialize_from(overlay, estimated(12, 16, transmittance, addition), guide_of(statistics))
    T, B = (layer.detach() for layer in overlay.layers(resolution))
    half = 8 // resolution
    torch.testing.assert_close(T[:, :half], torch.full_like(T[:, :half], transmittance), atol=1e-5, rtol=0)
    assert (B[:, :half] - torch.tensor(addition)).abs().max() < 0.02
    rim = -(-1 // resolution)
    assert (T[:, half + rim :] > 0.989).all()
    torch.testing.assert_close(overlay.evidence[:, :half], T[:, :half], atol=1e-5, rtol=0)
    assert (overlay.evidence[:, half + rim :] == 1).all()
    assert float(overlay.noise) == pytest.approx(0.03)  # what sparsity may weigh
    # Where nothing was found, the color is the artifact's: a matte there grows only where the artifact is.
    likely = torch.tensor(addition) / (1 - transmittance)
    assert (overlay.color()[:, half + rim :] - likely.clamp(0.002, 1)).abs().max() < 0.1


@pytest.mark.parametrize(("brightness", "own"), [(200, True), (80, False)])
def test_a_part_of_the_detected_area_starts_in_a_color_that_it_can_have(brightness: int, own: bool) -> None:
    """Text that the points missed beside a dark thumb: white text cannot be the thumb's, dark text can."""
    photo = torch.full((12, 26, 3), 90, dtype=torch.uint8)
    photo[4:6, 21:24] = brightness
    guide = guide_of(accumulate((photo, None) for _ in range(2)))
    static = torch.zeros(12, 26, dtype=torch.bool)
    static[:, :12] = static[4:6, 21:24] = True
    overlay = ScreenSpaceOverlay(12, 26)
    initialize_from(overlay, estimated(12, 26, 0.1, (0.3, 0.1, 0.1)), guide, static)
    color, thumb = overlay.color(), torch.tensor([0.3, 0.1, 0.1]) / 0.9
    assert (color[4:6, 21:24] - (brightness / 255 if own else thumb)).abs().max() < 0.01
    assert (color[:, :12] - thumb).abs().max() < 0.01
    assert (color[8:, 20:] - thumb).abs().max() < 0.01
    assert overlay.matte()[4:6, 21:24].max() < 0.011


def test_a_part_starts_in_the_color_of_what_was_found_in_it() -> None:
    """Half of a white letter is found, and the rest of it starts white beside a dark thumb, too."""
    layers = estimated(12, 26, 0.1, (0.3, 0.1, 0.1))
    layers.transmittance[5, 21:23], layers.addition[5, 21:23] = 0.2, 0.8
    guide = guide_of(accumulate((torch.full((12, 26, 3), 90, dtype=torch.uint8), None) for _ in range(2)))
    static = torch.zeros(12, 26, dtype=torch.bool)
    static[2:10, 21:23] = True
    overlay = ScreenSpaceOverlay(12, 26)
    initialize_from(overlay, layers, guide, static)
    assert (overlay.color()[2:10, 21:23] > 0.7).all()


@pytest.mark.parametrize(("core", "edge", "kept"), [(0.2, False, False), (0.4, False, True), (0.2, True, True)])
def test_a_weak_film_counts_only_around_what_is_certain(core: float, edge: bool, kept: bool) -> None:
    """A film of 0.2 beside an artifact that is certain: errors of the points make such films."""
    layers = estimated(12, 40, 0.1, (0.3, 0.1, 0.1))
    for part, opacity in ((slice(26, 36), 0.2), (slice(30, 32), core)):
        layers.transmittance[2:10, part], layers.addition[2:10, part] = 1 - opacity, 0.1 * opacity
    static = torch.zeros(12, 40, dtype=torch.bool)
    static[5, 34] = edge
    overlay = ScreenSpaceOverlay(12, 40)
    initialize_from(overlay, layers, guide_of(capture(12, 40)[1]), static)
    matte = overlay.matte()[2:10, 26:36]
    assert (matte.min() > 0.19) if kept else (matte.max() < 0.011)
    assert overlay.matte()[:, :20].min() > 0.89


@pytest.mark.parametrize(("certain", "kept"), [(4, False), (5, True)])
def test_a_film_counts_only_if_more_than_a_twentieth_of_it_is_certain(certain: int, kept: bool) -> None:
    """A film of 80 pixels: errors reach more than 0.3 in a few of them, too."""
    layers = estimated(12, 40, 0.1, (0.3, 0.1, 0.1))
    layers.transmittance[2:10, 26:36], layers.addition[2:10, 26:36] = 0.8, 0.02
    layers.transmittance[4, 28 : 28 + certain], layers.addition[4, 28 : 28 + certain] = 0.6, 0.04
    overlay = ScreenSpaceOverlay(12, 40)
    initialize_from(overlay, layers, guide_of(capture(12, 40)[1]))
    assert (overlay.matte()[2:10, 26:36].min() > 0.19) == kept


def test_a_rim_that_would_be_noise_by_itself_is_kept_for_a_pixel() -> None:
    layers = estimated(12, 40, 0.1, (0.3, 0.1, 0.1))
    layers.transmittance[:, 26:32], layers.transmittance[:, 32:35] = 0.5, 0.92
    overlay = ScreenSpaceOverlay(12, 40)
    initialize_from(overlay, layers, guide_of(capture(12, 40)[1]))
    matte = overlay.matte()[6, :, 0]
    assert matte[31] > 0.4
    assert 0.05 < matte[32] < 0.3
    assert matte[34] < 0.011


@pytest.mark.parametrize(("transmittance", "hides"), [(0.6, False), (0.4, True), (0.05, True)])
def test_additive_light_hides_the_scene_where_it_hides_most_of_it(transmittance: float, hides: bool) -> None:
    """A dashboard behind rain does. Elsewhere errors of T are no reason to take weak light for more than noise."""
    layers = estimated(12, 40, 0.1, (0.3, 0.1, 0.1))
    layers.transmittance[:, 26:36], layers.addition[:, 26:36] = transmittance, 0.08
    overlay = ScreenSpaceOverlay(12, 40, adds_light=True)
    initialize_from(overlay, layers, guide_of(capture(12, 40)[1]))
    found, added = (layer[:, 27:35] for layer in overlay.layers())
    torch.testing.assert_close(found, torch.full_like(found, transmittance if hides else 0.99))
    torch.testing.assert_close(overlay.evidence[:, 27:35], torch.full_like(found, transmittance if hides else 1.0))
    assert ((added - 0.08).abs().max() < 0.01) if hides else (added.max() < 0.02)


def test_the_rim_of_what_hides_beside_additive_light_is_kept_for_a_pixel() -> None:
    layers = estimated(12, 40, 1.0, (0.0, 0.0, 0.0))
    layers.transmittance[:, 26:32], layers.transmittance[:, 32:35] = 0.1, 0.7
    overlay = ScreenSpaceOverlay(12, 40, adds_light=True)
    initialize_from(overlay, layers, guide_of(capture(12, 40)[1]))
    matte = overlay.matte()[6, :, 0]
    assert matte[31] > 0.8
    assert 0.2 < matte[32] < 0.4
    assert matte[34] < 0.011


@pytest.mark.parametrize(("pixels", "hides"), [(9, False), (10, True)])
def test_additive_light_hides_no_area_that_may_be_an_error(pixels: int, hides: bool) -> None:
    """A fiftieth of 480 pixels may be."""
    layers = estimated(12, 40, 1.0, (0.0, 0.0, 0.0))
    layers.transmittance[5, 26 : 26 + pixels] = 0.1
    overlay = ScreenSpaceOverlay(12, 40, adds_light=True)
    initialize_from(overlay, layers, guide_of(capture(12, 40)[1]))
    assert bool((overlay.matte() > 0.5).any()) == hides


def test_additive_light_starts_without_a_matte() -> None:
    _, statistics = capture(12, 16)
    overlay = ScreenSpaceOverlay(12, 16, adds_light=True)
    initialize_from(overlay, estimated(12, 16, 0.9, (0.4, 0.3, 0.2)), guide_of(statistics))
    torch.testing.assert_close(overlay.matte(), torch.full((12, 16, 1), 0.01))
    assert (overlay.color()[:, :8] - torch.tensor([0.4, 0.3, 0.2])).abs().max() < 1e-5
    assert (overlay.evidence == 1).all()


def test_a_falloff_multiplies_what_is_behind_it_and_is_kept_where_that_is_noise() -> None:
    _, statistics = capture(12, 16)
    overlay = ScreenSpaceOverlay(12, 16)
    falloff = torch.linspace(0.5, 0.9, 16).expand(12, 16)[..., None]
    behind = estimated(12, 16, 0.6, (0.3, 0.2, 0.1))
    initialize_from(overlay, replace(behind, falloff=falloff), guide_of(statistics))
    T, B = (layer.detach() for layer in overlay.layers())
    torch.testing.assert_close(T[:, :7], 0.6 * falloff[:, :7], atol=1e-5, rtol=0)
    assert (B[:, :7] - falloff[:, :7] * torch.tensor([0.3, 0.2, 0.1])).abs().max() < 0.02
    # Clear starts at a matte of 0.01; sparsity knows nothing of the falloff.
    torch.testing.assert_close(T[:, 10:], 0.99 * falloff[:, 10:], atol=1e-5, rtol=0)
    torch.testing.assert_close(overlay.evidence[:, 10:], torch.ones(12, 6, 1), atol=1e-5, rtol=0)
    assert behind.share() == 0.5
    assert replace(behind, falloff=torch.full_like(falloff, 0.6)).share() == 1


def test_a_falloff_is_looked_for_beside_what_is_opaque(monkeypatch) -> None:
    """A working pixel of which any part is opaque counts as such."""
    asked: list[torch.Tensor] = []

    def spy(samples: PointSamples, opaque: torch.Tensor) -> torch.Tensor:
        asked.append(opaque)
        return torch.ones(160, 240, 1)

    monkeypatch.setattr(initialization, "estimate_falloff", spy)
    opaque, guide = torch.zeros(320, 480, dtype=torch.bool), torch.rand(320, 480, 4)
    opaque[:, 101:300] = True
    one = torch.zeros(1, dtype=torch.int64)
    samples = PointSamples(one, one, torch.full((1, 3), 0.5), 1, (160, 240), one)
    estimate(samples, guide, opaque, torch.zeros_like(opaque))
    columns = torch.arange(240)
    assert torch.equal(asked[0][..., 0], ((columns >= 50) & (columns < 150)).expand(160, 240))
