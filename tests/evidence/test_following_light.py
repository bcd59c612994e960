"""What follows the light on an artifact belongs to it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ssa_nerfstudio.evidence import following_light
from ssa_nerfstudio.evidence.following_light import follows_light
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate
from ssa_nerfstudio.evidence.point_samples import PointSamples
from ssa_nerfstudio.overlay.shading import COEFFICIENTS, coordinates_of

HEIGHT, WIDTH, VIEWS = 48, 64, 24
FOUND = slice(6, 20), slice(16, 32)
MISSED = slice(20, 42), slice(16, 32)
"""The rest of the arm, which the estimate takes for scene."""
APART = slice(6, 30), slice(48, 60)
ARM = torch.tensor([0.3, 0.25, 0.2])
NOISE = 0.02


def opacity_found() -> torch.Tensor:
    opacity = torch.zeros(HEIGHT, WIDTH, 1)
    opacity[FOUND] = 1.0
    return opacity


def drawn_light() -> torch.Tensor:
    """[V, COEFFICIENTS] of mean 0: of the gains, and less of the slopes."""
    generator = torch.Generator().manual_seed(2)
    size = torch.tensor([0.3, 0.3, 0.3, 0.1, 0.1])
    drawn = size * torch.randn(VIEWS, COEFFICIENTS, generator=generator)
    return drawn - drawn.mean(dim=0)


LIGHT = drawn_light()
EVEN = torch.cat([LIGHT[:, :3], torch.zeros(VIEWS, 2)], dim=1)
"""The same all over the artifact."""


def full_change(light: torch.Tensor) -> torch.Tensor:
    """Relative change of an opaque artifact's color in each photo, [V, h, w, 3]."""
    gains, slopes = light[:, None, None].split((3, 2), dim=-1)
    return gains + (coordinates_of(opacity_found()) * slopes).sum(dim=-1, keepdim=True)


def photographed(
    share: torch.Tensor, light: torch.Tensor = LIGHT, own: torch.Tensor | float = 0.0
) -> tuple[PointSamples, LayerEstimate]:
    """Samples of a point at every pixel in every photo, and an estimate that has found a part of the arm.

    Args:
        share: of the colors there that changes with the light, [h, w, 1].
        light: in each photo, [V, COEFFICIENTS].
        own: what else changes in each photo, [V, h, w, 3].
    """
    generator = torch.Generator().manual_seed(5)
    change = share * full_change(light)
    color = ARM * (1 + change) + own + NOISE * torch.randn(change.shape, generator=generator)
    pixels = torch.arange(HEIGHT * WIDTH)
    samples = PointSamples(
        point=pixels.repeat(VIEWS),
        pixel=pixels.repeat(VIEWS),
        color=color.reshape(-1, 3),
        points=HEIGHT * WIDTH,
        size=(HEIGHT, WIDTH),
        view=torch.arange(VIEWS).repeat_interleave(HEIGHT * WIDTH),
    )
    opacity = opacity_found()
    unexplained = torch.zeros_like(opacity)
    layers = 1 - opacity, opacity * ARM, torch.ones_like(opacity), unexplained, torch.tensor(NOISE)
    return samples.ordered(), LayerEstimate(*layers, colors=color.mean(dim=0).reshape(-1, 3))


def shares(**areas: tuple[tuple[slice, slice], float]) -> torch.Tensor:
    share = opacity_found()
    for place, value in areas.values():
        share[place] = value
    return share


def followed(samples: PointSamples, found: LayerEstimate, light: torch.Tensor = LIGHT) -> torch.Tensor:
    return follows_light(samples, found, found.opacity(), ARM.expand(HEIGHT, WIDTH, 3), light)[..., 0]


def within(place: tuple[slice, slice], wider: int) -> torch.Tensor:
    """An area, wider by so many pixels, or narrower."""
    rows, columns = place
    area = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    area[rows.start - wider : rows.stop + wider, columns.start - wider : columns.stop + wider] = True
    return area


def test_what_follows_the_light_next_to_what_is_found_belongs_to_it() -> None:
    follows = followed(*photographed(shares(rest=(MISSED, 1.0))))
    assert follows[within(MISSED, -2)].all()
    assert not follows[~(within(MISSED, 2) | within(FOUND, 2))].any(), "as far as a window reaches"


def test_what_is_not_connected_does_not() -> None:
    follows = followed(*photographed(shares(other=(APART, 1.0))))
    assert not follows[within(APART, 0)].any()
    assert not follows[within(MISSED, -2)].any()


def test_beside_a_small_part_nothing_follows() -> None:
    samples, found = photographed(shares(rest=(MISSED, 1.0)))
    small = torch.zeros_like(found.transmittance)
    small[14:20, 16:24] = 1.0
    assert small.mean() < 0.02
    assert not followed(samples, replace(found, transmittance=1 - small, addition=small * ARM)).any()


@pytest.mark.parametrize(("share", "follows"), [(0.4, False), (0.65, True)])
def test_more_than_half_has_to_follow(share: float, follows: bool) -> None:
    found = followed(*photographed(shares(rest=(MISSED, share))))[within(MISSED, -4)]
    assert found.all() if follows else not found.any()


def test_in_constant_light_nothing_follows() -> None:
    samples, found = photographed(torch.zeros(HEIGHT, WIDTH, 1))
    assert not followed(samples, found)[~within(FOUND, 0)].any()
    assert not followed(samples, found, torch.zeros_like(LIGHT)).any()


@pytest.mark.parametrize(("deviation", "follows"), [(0.5, True), (8.0, False)])
def test_what_a_scene_changes_by_itself_is_the_same_in_all_samples_of_a_photo(deviation: float, follows: bool) -> None:
    """By chance its changes may agree with the light's by as much as 0.8, but not significantly."""
    own = torch.randn(VIEWS, generator=torch.Generator().manual_seed(1))
    gain = EVEN[:, :3].mean(dim=1)
    own = own - own.mean()
    own = own - (own @ gain) / (gain @ gain) * gain
    own = deviation * own * gain.norm() / own.norm()
    place = torch.zeros(HEIGHT, WIDTH, 1)
    place[MISSED] = 1.0
    changes = own[:, None, None, None] * place * ARM
    found = followed(*photographed(shares(rest=(MISSED, 0.8)), EVEN, changes), EVEN)[within(MISSED, -4)]
    assert found.all() if follows else not found.any()


@pytest.mark.parametrize(("photos", "follows"), [(1, False), (12, True)])
def test_one_photo_is_not_certain_because_it_agrees_with_itself(photos: int, follows: bool) -> None:
    samples, found = photographed(shares(rest=(MISSED, 1.0)))
    kept = within(FOUND, 0).flatten()[samples.pixel] | (samples.view < photos)
    fewer = {name: getattr(samples, name)[kept] for name in ("point", "pixel", "color", "view")}
    assert followed(replace(samples, **fewer), found)[within(MISSED, -5)].any() == follows


def test_light_from_the_side_changes_the_rest_of_the_artifact_by_its_place() -> None:
    slopes = torch.cat([torch.zeros(VIEWS, 3), 3 * LIGHT[:, 3:]], dim=1)
    assert followed(*photographed(shares(rest=(MISSED, 1.0)), slopes), slopes)[within(MISSED, -4)].all()


def test_a_highlight_that_lies_elsewhere_follows_the_light_all_the_same() -> None:
    """Where the artifact has found changes from the side, the rest of it changes as a whole, and the reverse."""
    slopes = torch.cat([torch.zeros(VIEWS, 3), 3 * LIGHT[:, 3:]], dim=1)
    samples, found = photographed(shares(rest=(MISSED, 1.0)), slopes)
    exchanged = torch.cat([torch.zeros(VIEWS, 3), slopes[:, 3:].flip(1)], dim=1)
    assert followed(samples, found, exchanged)[within(MISSED, -4)].float().mean() > 0.9


def test_where_nothing_large_hides_the_scene_nothing_is_looked_for() -> None:
    samples, found = photographed(shares(rest=(MISSED, 1.0)))
    clear = torch.zeros_like(found.transmittance)
    clear_found = replace(found, transmittance=1 - clear, addition=torch.zeros_like(found.addition))
    assert not followed(samples, clear_found).any()


def test_what_is_found_by_few_samples_is_found_by_those_around() -> None:
    """One pixel in nine has samples."""
    samples, found = photographed(shares(rest=(MISSED, 1.0)))
    rows, columns = samples.pixel // WIDTH, samples.pixel % WIDTH
    kept = (rows % 3 == 0) & (columns % 3 == 0)
    fewer = {name: getattr(samples, name)[kept] for name in ("point", "pixel", "color", "view")}
    assert followed(replace(samples, **fewer), found)[within(MISSED, -4)].all()


def test_of_many_photos_a_regular_subset_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    samples, found = photographed(shares(rest=(MISSED, 1.0)))
    monkeypatch.setattr(following_light, "MAX_VIEWS", 12)
    follows = followed(samples, found)
    color = torch.where((samples.view % 2 == 0)[:, None], samples.color, 0.5)
    assert torch.equal(followed(replace(samples, color=color), found), follows)
    assert follows[within(MISSED, -4)].all()


@pytest.mark.parametrize("beside", [0.1, 0.3])
def test_the_rim_of_a_bright_artifact_does_not_follow_its_light(beside: float) -> None:
    samples, found = photographed(opacity_found())
    bright = torch.where(opacity_found() > 0, 0.8, beside).expand(HEIGHT, WIDTH, 3)
    scale = (bright / ARM).reshape(-1, 3)[samples.pixel]
    samples = replace(samples, color=samples.color * scale)
    assert found.colors is not None
    colors = found.colors * (bright / ARM).reshape(-1, 3)
    found = replace(found, addition=found.opacity() * bright, colors=colors)
    follows = follows_light(samples, found, found.opacity(), bright, LIGHT)[..., 0]
    assert follows[within(FOUND, -2)].all()
    assert not follows[~within(FOUND, 0)].any()


def test_light_in_one_photo_and_a_change_of_the_scene_in_it_are_chance() -> None:
    once = torch.zeros(VIEWS, COEFFICIENTS)
    once[7, :3] = 0.5
    once = once - once.mean(dim=0)
    own = torch.randn(VIEWS, generator=torch.Generator().manual_seed(3))
    own[7] = 3.0
    place = torch.zeros(HEIGHT, WIDTH, 1)
    place[MISSED] = 1.0
    changes = 0.15 * (own - own.mean())[:, None, None, None] * place * ARM
    assert not followed(*photographed(opacity_found(), once, changes), once)[within(MISSED, -4)].any()


def test_by_chance_few_photos_agree_rarely() -> None:
    """Changes of a scene in eight photos, drawn 60 times: the test's level is 0.01."""
    few = LIGHT[:8] - LIGHT[:8].mean(dim=0)
    terms = torch.stack([torch.cat([few[:, c, None], few[:, 3:]], dim=1) for c in range(3)])
    generator = torch.Generator().manual_seed(6)
    own = torch.randn(3000, 8, 1, generator=generator)
    left, weight = own.expand(-1, -1, 3), torch.ones(3000, 8, 3)
    products = torch.einsum("pvc,cvi,cvj->pij", weight, terms, terms)
    sums = torch.einsum("pvc,cvi->pi", left, terms)[..., None]
    free = torch.eye(3).expand(3000, 3, 3)
    for basis, most in ((free[..., :1], 0.03), (free, 0.05)):
        assert following_light._fit(left, weight, terms, products, sums, basis)[1].float().mean() < most
