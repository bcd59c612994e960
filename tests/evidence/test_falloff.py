"""Falloff of light, estimated from points: synthetic tracks whose falloff is known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ssa_nerfstudio.evidence import falloff
from ssa_nerfstudio.evidence.falloff import estimate_falloff
from ssa_nerfstudio.evidence.point_samples import PointSamples

HEIGHT, WIDTH, POINTS, VIEWS = 36, 48, 400, 40
Y, X = torch.meshgrid(torch.linspace(-0.6, 0.6, HEIGHT), torch.linspace(-0.8, 0.8, WIDTH), indexing="ij")
FALLOFF = 1 - 0.7 * (X.square() + Y.square()) ** 1.5
"""1 in the center, 0.3 in the corners."""
NOT_RADIAL = {
    "nothing": torch.ones(HEIGHT, WIDTH),
    "light from the left": 1 - 0.3 * (X + 0.8),
    "a dark lower edge": 0.2 + 0.8 * torch.sigmoid((0.4 - Y) / 0.05),
    "an operator in the middle of the lower face": 0.2 + 0.8 * torch.sigmoid((torch.hypot(X, Y) - 0.3) / 0.05),
    "a dark middle": (1 - 6 * (torch.hypot(X, Y) - 0.33).square()).clamp_min(0.2),
    "a watermark in the middle": 1 + 2 * torch.sigmoid((0.15 - torch.hypot(X, Y)) / 0.02),
    "a large one": 1 + 2 * torch.sigmoid((0.3 - torch.hypot(X, Y)) / 0.05),
    "a soft one": 1 + 2 * torch.sigmoid((0.4 - torch.hypot(X, Y)) / 0.1),
    "light of one corner and its opposite, and less outside": (1 - 0.3 * (X**2 + Y**2)) * (1 - 0.8 * X * Y),
    "a wide watermark in the middle": 1 + 2 * torch.sigmoid((0.3 - torch.hypot(X / 1.3, Y)) / 0.05),
    "four panels in the corners": torch.where((X.abs() > 0.4) & (Y.abs() > 0.3), 0.5, 1.0),
    "a finger": 0.2 + 0.8 * torch.sigmoid((torch.hypot(X - 0.7, Y - 0.5) - 0.4) / 0.05),
}


OF_THE_FRAME = {
    "ellipse": 1 - 0.7 * (((X / 0.8) ** 2 + (Y / 0.6) ** 2) / 2) ** 1.5,
    "squarer": 1 - 0.7 * (((X / 0.8) ** 4 + (Y / 0.6) ** 4) / 2) ** 0.75,
    "almost a rectangle": 1 - 0.7 * (((X / 0.8) ** 8 + (Y / 0.6) ** 8) / 2) ** 0.375,
}
"""As photo editors darken corners."""


def samples(transmittance: Tensor, wrong: float = 0.1, seed: int = 0) -> PointSamples:
    """Points that wander through the frame, photos of several gains, and samples that show something else."""
    generator = torch.Generator().manual_seed(seed)
    color = 0.1 + 0.6 * torch.rand(POINTS, 1, generator=generator)
    start = torch.rand(POINTS, 1, 2, generator=generator) - 0.5
    way = torch.rand(POINTS, 1, 2, generator=generator) - 0.5
    place = start + way * torch.linspace(-1, 1, VIEWS)[:, None]
    place = ((place + 0.5) * torch.tensor([HEIGHT, WIDTH])).long()
    inside = ((place >= 0) & (place < torch.tensor([HEIGHT, WIDTH]))).all(dim=-1)
    point, view = inside.nonzero(as_tuple=True)
    pixel = (place[..., 0] * WIDTH + place[..., 1])[inside]
    gain = (0.1 * torch.randn(VIEWS, generator=generator)).exp()[view, None]
    shown = gain * transmittance.flatten()[pixel, None] * color[point]
    other = torch.rand(shown.shape, generator=generator)
    shown = torch.where(torch.rand(shown.shape, generator=generator) < wrong, other, shown)
    shown = (shown + 0.01 * torch.randn(len(point), 3, generator=generator)).clamp(0, 1)
    return PointSamples(point, pixel, shown, POINTS, (HEIGHT, WIDTH), view)


def relative(falloff: Tensor) -> Tensor:
    """To the clearest fifth of the frame, of which it is the mean that is 1."""
    clearest = falloff[falloff.flatten().quantile(0.8) <= falloff].log().mean().exp()
    return (falloff / clearest).clamp_max(1)


@pytest.mark.parametrize(("wrong", "seed"), [(0.1, 0), (0.1, 1), (0.3, 0), (0.3, 1)])
def test_a_falloff_is_found_up_to_the_clearest_part_of_the_frame(wrong: float, seed: int) -> None:
    """Also where a third of the samples shows something else, most of it brighter than what is in the corners."""
    found = estimate_falloff(samples(FALLOFF, wrong, seed))[..., 0]
    assert (found - relative(FALLOFF)).abs().max() < 0.04


def test_samples_without_any_noise_have_no_falloff() -> None:
    whole = samples(torch.ones(HEIGHT, WIDTH), wrong=0.0)
    assert (estimate_falloff(replace(whole, color=torch.full_like(whole.color, 0.5))) == 1).all()


def test_patches_count_not_the_points_own_colors() -> None:
    whole = samples(FALLOFF)
    nearer = replace(whole, color=whole.color * (1 + 0.5 * (X**2 + Y**2)).flatten()[whole.pixel, None])
    expected = estimate_falloff(whole)
    assert (estimate_falloff(nearer) - expected).abs().max() > 0.1
    torch.testing.assert_close(estimate_falloff(replace(nearer, patch=whole.color)), expected)


def test_a_falloff_is_round_in_angles_not_in_pixels() -> None:
    """Photos stretched by 0.8 along x, as undistortion may leave them."""
    stretched = 1 - 0.7 * (((X / 0.8).square() + Y.square()) / 1.36) ** 1.5
    whole = samples(stretched)
    expected = relative(stretched)
    assert (estimate_falloff(whole)[..., 0] - expected).abs().max() > 0.06
    assert (estimate_falloff(replace(whole, focal_ratio=0.8))[..., 0] - expected).abs().max() < 0.04


@pytest.mark.parametrize("name", OF_THE_FRAME)
def test_a_falloff_may_be_as_wide_and_as_high_as_the_frame_in_place_of_round(name: str) -> None:
    """Also where the lens was wider than high, and its photos are stretched."""
    expected = relative(OF_THE_FRAME[name])
    for focal_ratio in (1.0, 0.8):
        whole = replace(samples(OF_THE_FRAME[name]), focal_ratio=focal_ratio)
        assert (estimate_falloff(whole)[..., 0] - expected).abs().mean() < 0.02


@pytest.mark.parametrize("begins", [0.0, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
def test_a_falloff_may_begin_anywhere(begins: float) -> None:
    """Polynomials ripple where it is flat, and samples are noisy: the middle is often a little darker than the rest."""
    falloff = 1 - 0.7 * ((torch.hypot(X, Y) - begins) / (1 - begins)).clamp_min(0)
    for seed in range(3):
        found = estimate_falloff(samples(falloff, wrong=0.3, seed=seed))[..., 0]
        assert (found - relative(falloff)).abs().mean() < 0.03


@pytest.mark.parametrize("brightness", [1.0, 0.3, 0.1])
def test_gains_of_views_are_no_falloff_however_dark_the_photos_are(brightness: float) -> None:
    """Every second view has a gain of 0.6, and sees little of the middle."""
    whole = samples(FALLOFF)
    middle = (torch.hypot(X, Y) < 0.4).flatten()[whole.pixel]
    dark = whole.view % 2 == 1
    kept = ~(dark & middle & (torch.arange(len(dark)) % 10 > 0))
    color = brightness * whole.color * torch.where(dark, 0.6, 1.0)[:, None]
    parts = {name: getattr(whole, name)[kept] for name in ("point", "pixel", "view")}
    found = estimate_falloff(replace(whole, color=color[kept], **parts))
    assert (found - estimate_falloff(whole)).abs().max() < 0.04


@pytest.mark.parametrize("name", NOT_RADIAL)
def test_what_is_not_radial_or_not_darkest_outside_is_no_falloff(name: str) -> None:
    assert (estimate_falloff(samples(NOT_RADIAL[name])) == 1).all()


def behind_bars(transmittance: Tensor, outside: Tensor, seed: int = 0) -> tuple[PointSamples, Tensor]:
    """Samples whose frame is black outside, and where it is; their patches leave that out."""
    whole = samples(transmittance, seed=seed)
    black = outside.flatten()[whole.pixel, None]
    color = torch.where(black, 0.05, whole.color)
    return replace(whole, color=color, patch=torch.where(black, torch.nan, color)), outside[..., None]


def test_black_bars_beside_the_frame_are_no_falloff() -> None:
    """A circle, which is as round as a lens, and bars, beyond which nothing is seen."""
    for outside in (torch.hypot(X, Y) > 0.65, X.abs() > 0.45, X.abs().maximum(Y.abs()) > 0.4):
        seen, opaque = behind_bars(torch.ones(HEIGHT, WIDTH), outside)
        assert (estimate_falloff(seen, opaque) == 1).all()
    seen, opaque = behind_bars(torch.ones(HEIGHT, WIDTH), torch.hypot(X, Y) > 0.65)
    assert estimate_falloff(replace(seen, patch=None)).min() < 0.5, "as it used to be"


@pytest.mark.parametrize("outside", [X.abs() > 0.6, torch.hypot(X, Y) > 0.75], ids=["bars", "circle"])
def test_a_falloff_between_black_bars_is_found_and_goes_no_further(outside: Tensor) -> None:
    found = estimate_falloff(*behind_bars(FALLOFF, outside))[..., 0]
    inside = FALLOFF[~outside]
    clearest = inside[inside >= inside.quantile(0.8)].log().mean().exp()
    assert ((found - (FALLOFF / clearest).clamp_max(1)).abs()[~outside]).max() < 0.05
    assert found.min() == found[~outside].min()


def test_modes_are_orthonormal_over_what_is_seen() -> None:
    """Only then does the test compare squares of one variance."""
    clear = (X.abs() < 0.5).flatten()
    modes = falloff._modes(falloff._places(HEIGHT, WIDTH, 1.1), clear)
    assert modes is not None
    torch.testing.assert_close(modes[clear].T @ modes[clear], torch.eye(17).double(), rtol=0, atol=1e-9)
    assert modes[clear].mean(dim=0).abs().max() < 1e-9
    two_rows = torch.arange(HEIGHT * WIDTH) < 2 * WIDTH
    assert falloff._modes(falloff._places(HEIGHT, WIDTH, 1.1), two_rows) is None


def test_samples_at_opaque_pixels_do_not_count_though_their_patches_reach_beyond() -> None:
    outside = X.abs() > 0.5
    seen, opaque = behind_bars(FALLOFF, outside)
    assert seen.patch is not None
    wrong = replace(seen, patch=torch.where(outside.flatten()[seen.pixel, None], 0.9, seen.patch))
    torch.testing.assert_close(estimate_falloff(wrong, opaque), estimate_falloff(seen, opaque))


def test_what_is_hidden_nearly_everywhere_has_no_falloff() -> None:
    seen, _ = behind_bars(FALLOFF, X.abs() > 0.1)
    for opaque in ((X.abs() > 0.1)[..., None], torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)):
        assert (estimate_falloff(seen, opaque) == 1).all()


def test_samples_that_say_nothing_find_nothing() -> None:
    every = samples(FALLOFF)
    assert (estimate_falloff(replace(every, color=torch.ones_like(every.color))) == 1).all()
    assert (estimate_falloff(replace(every, pixel=torch.zeros_like(every.pixel))) == 1).all()


@pytest.mark.parametrize(("chance", "found"), [(0.004, True), (0.006, False)])
def test_two_hypotheses_share_the_level_of_significance(monkeypatch, chance: float, found: bool) -> None:
    monkeypatch.setattr(falloff, "_chance", lambda those, others: chance)
    assert bool((estimate_falloff(samples(OF_THE_FRAME["squarer"])) < 1).any()) == found


def test_a_mode_that_belongs_to_a_squarer_falloff_is_no_noise() -> None:
    clear = torch.ones(HEIGHT * WIDTH, dtype=torch.bool)
    observed = [falloff._observed(samples(each), clear) for each in (OF_THE_FRAME["squarer"], FALLOFF)]
    assert observed[0] is not None
    assert observed[1] is not None
    squarer, lens = falloff._test(observed[0], WIDTH / HEIGHT), falloff._test(observed[1], 1.0)
    assert squarer is not None
    assert lens is not None
    assert (squarer.modes.shape[1], squarer.freedom) == (6, 11)
    assert (lens.modes.shape[1], lens.freedom) == (5, 12)
    assert squarer.error < 0.1


@pytest.mark.parametrize("begins", [0.0, 0.5, 0.6, 0.7])
def test_a_falloff_between_bars_may_begin_far_from_the_middle(begins: float) -> None:
    outside = X.abs() > 0.6
    beginning = 1 - 0.7 * ((torch.hypot(X, Y) - begins) / (1 - begins)).clamp_min(0)
    inside = beginning[~outside]
    for seed in range(3):
        seen, opaque = behind_bars(beginning, outside, seed)
        found = estimate_falloff(seen, opaque)[..., 0][~outside]
        clearest = inside[inside >= inside.quantile(0.8)].log().mean().exp()
        assert (found - (inside / clearest).clamp_max(1)).abs().mean() < 0.03
