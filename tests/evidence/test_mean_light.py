"""A second estimate in the artifact's mean light."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from ssa_nerfstudio.evidence import mean_light
from ssa_nerfstudio.evidence.artifact_light import artifact_light
from ssa_nerfstudio.evidence.changing_area import moving_parts
from ssa_nerfstudio.evidence.detection import detect
from ssa_nerfstudio.evidence.initialization import estimate, guide_of, initialize_from
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate
from ssa_nerfstudio.evidence.mean_light import (
    Refined,
    guide_in_mean_light,
    in_mean_light,
    light_of_samples,
    refine_in_mean_light,
    second_estimate,
)
from ssa_nerfstudio.evidence.point_samples import View, sample_points
from ssa_nerfstudio.evidence.statistics import UNKNOWN_DEVIATION, accumulate
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.shading import basis_of, light, shading_basis

HEIGHT, WIDTH, VIEWS = 90, 120, 24
K = torch.tensor([[100.0, 0.0, WIDTH / 2], [0.0, 100.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
TRANSMITTANCE, COLOR = 0.25, torch.tensor([0.5, 0.35, 0.3])


def texture(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Of a wall at depth 1: [..., 3] in [0.1, 0.9]."""
    waves = [0.25 * (torch.sin(9 * x + 5 * i) + torch.sin(11 * y + 3 * x + 2 * i)) for i in range(3)]
    return (0.5 + 0.8 * torch.stack(waves, dim=-1)).clamp(0.1, 0.9)


def finger(transmittance: float = TRANSMITTANCE) -> tuple[torch.Tensor, torch.Tensor]:
    """Layers of what covers the left third of the frame."""
    opacity = (1 - transmittance) * (torch.arange(WIDTH) < WIDTH // 3).float().expand(HEIGHT, WIDTH)[..., None]
    return 1 - opacity, opacity * COLOR


def views(coefficients: torch.Tensor, vertically: float = 0.8, through: float = TRANSMITTANCE) -> list[View]:
    """A camera that moves along the wall, and so far up and down, behind a finger in this light [V, 5]."""
    generator, found = torch.Generator().manual_seed(3), []
    transmittance, addition = finger(through)
    basis = shading_basis(1 - transmittance)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    for own in coefficients:
        pose = torch.eye(4)
        pose[:2, 3] = torch.tensor([0.8, vertically]) * (torch.rand(2, generator=generator) - 0.5)
        wall = texture((columns - WIDTH / 2) / 100 - pose[0, 3], (rows - HEIGHT / 2) / 100 - pose[1, 3])
        photo = (transmittance * wall + light(basis, own) * addition).clamp(0, 1)
        found.append(View((255 * photo).round().to(torch.uint8), None, pose, K))
    return found


def points() -> torch.Tensor:
    x, y = 2 * torch.rand(2, 6000, generator=torch.Generator().manual_seed(4)) - 1
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


CONSTANT = torch.zeros(VIEWS, 5)


def changing() -> torch.Tensor:
    """Coefficients [V, 5]: brightness, tint and slopes."""
    generator = torch.Generator().manual_seed(1)
    brightness = 0.2 * torch.randn(VIEWS, 1, generator=generator)
    drawn = torch.cat([brightness.expand(-1, 3), torch.zeros(VIEWS, 2)], dim=1)
    drawn = drawn + 0.06 * torch.randn(VIEWS, 5, generator=generator)
    return drawn - drawn.mean(dim=0)


class Start:
    """The start from photos as they are, and what a second estimate is made of."""

    def __init__(self, photos: list[View]) -> None:
        statistics = accumulate((view.image, view.mask) for view in photos)
        self.detection, self.guide, self.photos = detect(statistics), guide_of(statistics), photos
        self.samples = sample_points(points(), photos, self.guide)
        self.found = estimate(self.samples, self.guide, self.detection.opaque, self.detection.mask)
        self.overlay = ScreenSpaceOverlay(HEIGHT, WIDTH)
        initialize_from(self.overlay, self.found, self.guide, self.detection.mask)
        self.error = error(self.overlay)

    def refined(self) -> Refined:
        second = second_estimate(self.overlay, self.found, self.samples, self.guide, self.photos, self.detection)
        return refine_in_mean_light(self.overlay, self.found, second, self.detection.mask)


def error(overlay: ScreenSpaceOverlay, through: float = TRANSMITTANCE) -> float:
    """Mean absolute error of T where the finger is, without its edge."""
    return float((overlay.layers()[0].detach() - through)[:, : WIDTH // 3 - 8].abs().mean())


def test_where_the_light_changes_a_second_estimate_is_nearer_to_the_truth():
    start = Start(views(changing()))
    second, may_move = start.refined()
    assert second is not start.found
    assert not may_move
    assert second.noise < start.found.noise
    assert error(start.overlay) < min(0.01, 0.7 * start.error)
    assert start.overlay.noise == second.noise


def test_the_second_estimate_is_told_how_much_photos_vary_without_the_light(monkeypatch):
    start, told = Start(views(changing())), []
    monkeypatch.setattr(
        mean_light, "estimate", lambda samples, guide, *others: told.append(guide) or estimate(samples, guide, *others)
    )
    start.refined()
    hidden = slice(None), slice(0, WIDTH // 3 - 2), 3
    assert told[0][hidden].mean() < 0.8 * start.guide[hidden].mean()
    torch.testing.assert_close(told[0][:, WIDTH // 2 :], start.guide[:, WIDTH // 2 :])


def test_in_constant_light_nothing_is_lost():
    """What is smooth in the scene passes for light here."""
    start = Start(views(CONSTANT))
    layers, may_move = start.refined()
    assert error(start.overlay) < 0.001
    assert not may_move or not moving_parts(layers, start.samples).any()


def test_where_light_explains_little_the_second_estimate_is_of_the_samples_as_they_are(monkeypatch):
    """As where an artifact moves, which passes for light."""
    start, told = Start(views(CONSTANT)), []
    monkeypatch.setattr(mean_light, "changing_light", lambda *given: "a light")
    monkeypatch.setattr(mean_light, "estimate", lambda *given: told.append(given) or estimate(*given))
    assert start.refined().may_move
    samples, guide, *_, follows = told[-1]
    assert samples is start.samples
    assert torch.equal(guide, start.guide)
    assert not follows[:, WIDTH // 3 + 5 :].any()
    assert error(start.overlay) < start.error + 0.02
    again = second_estimate(start.overlay, start.found, start.samples, start.guide, start.photos, start.detection)
    assert again is not None
    assert torch.equal(again.guide, start.guide), "in the light of each photo"


@pytest.mark.parametrize(("most", "may_move"), [(math.inf, False), (0.0, True)])
def test_how_much_is_left_decides_which_second_estimate_is_made_and_whether_parts_may_move(monkeypatch, most, may_move):
    start = Start(views(changing()))
    monkeypatch.setattr(mean_light, "MOST_LEFT", most)
    told = []
    monkeypatch.setattr(mean_light, "estimate", lambda *given: told.append(given[0]) or estimate(*given))
    second, moves = start.refined()
    assert moves == may_move
    assert start.overlay.noise == second.noise
    assert (told[-1] is start.samples) == may_move, "as they are, or in the mean light"


def test_where_nothing_follows_the_light_either_the_first_estimate_holds(monkeypatch):
    start = Start(views(changing()))
    monkeypatch.setattr(mean_light, "MOST_LEFT", 0.0)
    monkeypatch.setattr(mean_light, "follows_light", lambda *given: torch.zeros(HEIGHT, WIDTH, 1, dtype=torch.bool))
    assert start.refined() == (start.found, True)
    assert error(start.overlay) == start.error


def test_points_that_are_always_behind_the_artifact_do_not_make_it_a_scene(monkeypatch):
    """Of what the lower half hides, no photo shows anything beside it."""
    start = Start(views(changing(), vertically=0.0, through=0.05))
    samples, lower = start.samples, WIDTH * HEIGHT // 2
    inside = samples.pixel % WIDTH < WIDTH // 3
    behind = torch.zeros(samples.points, dtype=torch.bool)
    behind[samples.point[inside & (samples.pixel >= lower)]] = True
    kept = inside | ~behind[samples.point]
    fewer = {name: getattr(samples, name)[kept] for name in ("point", "pixel", "color", "view")}
    start.samples = replace(samples, **fewer, patch=None)
    start.found = estimate(start.samples, start.guide, start.detection.opaque, start.detection.mask)
    initialize_from(start.overlay, start.found, start.guide, start.detection.mask)
    before = error(start.overlay, 0.05)
    assert before > 0.1
    monkeypatch.setattr(mean_light, "MOST_LEFT", 0.0)
    start.refined()
    assert error(start.overlay, 0.05) < 0.7 * before


def test_without_a_hidden_sample_there_is_no_second_estimate():
    start = Start(views(changing()))
    shown = start.samples.pixel % WIDTH >= WIDTH // 2
    fewer = {name: getattr(start.samples, name)[shown] for name in ("point", "pixel", "color", "view")}
    samples = replace(start.samples, **fewer, patch=None)
    assert second_estimate(start.overlay, start.found, samples, start.guide, start.photos, start.detection) is None


def test_without_a_second_estimate_the_first_holds():
    start = Start(views(CONSTANT))
    assert refine_in_mean_light(start.overlay, start.found, None, start.detection.mask) == (start.found, False)
    assert error(start.overlay) == start.error


def rms(difference: torch.Tensor) -> float:
    return float(difference.square().mean().sqrt())


def test_light_is_told_from_the_scene_that_comes_through():
    """A fit of the photos alone takes what is smooth in the scene for light."""
    start = Start(views(changing()))
    basis = basis_of(start.overlay)
    samples = light_of_samples(start.samples, start.found, basis, VIEWS)
    images = [view.image for view in start.photos]
    photos = artifact_light(images, [None] * VIEWS, basis, start.overlay.layers()).coefficients
    assert rms((samples - changing())[:, :3]) < 0.05
    assert rms((samples - changing())[:, :3]) < 0.5 * rms((photos - changing())[:, :3])
    assert rms((samples - changing())[:, 3:]) < 0.03, "of 0.06"
    torch.testing.assert_close(samples.mean(dim=0), torch.zeros(5), atol=1e-6, rtol=0)


def true_estimate(start: Start, falloff: torch.Tensor | None = None) -> LayerEstimate:
    """The layers and the points' colors as they are."""
    colors = texture(points()[:, 0], points()[:, 1])
    transmittance, addition = finger()
    falloff = torch.ones_like(transmittance) if falloff is None else falloff
    return replace(start.found, falloff=falloff, addition=addition, transmittance=transmittance, colors=colors)


BASIS = shading_basis(1 - finger()[0])


def linear(coefficients: torch.Tensor) -> torch.Tensor:
    """Coefficients of the linear light that is nearest to this one where the artifact is, over that of its mean."""
    here = BASIS[..., 0] > 0
    factor = torch.stack([light(BASIS, own)[here] for own in coefficients]) - 1
    slopes, gains = BASIS[here][:, 1:], BASIS[here][:, :1]
    terms = torch.cat([torch.diag_embed(gains.expand(-1, 3)), slopes[:, None].expand(-1, 3, 2)], dim=-1).reshape(-1, 5)
    fitted = torch.linalg.lstsq(terms, factor.reshape(VIEWS, -1).T).solution.T
    return fitted - fitted.mean(dim=0)


def test_the_fit_is_exact_where_layers_and_colors_are():
    start = Start(views(changing()))
    found = light_of_samples(start.samples, true_estimate(start), BASIS, VIEWS)
    assert rms(found - linear(changing())) < 0.01


def test_samples_that_nothing_explains_have_little_say():
    start = Start(views(changing()))
    color = start.samples.color.clone()
    color[::10] = 1.0
    found = light_of_samples(replace(start.samples, color=color), true_estimate(start), BASIS, VIEWS)
    assert rms(found - linear(changing())) < 0.02


def test_a_view_with_few_samples_has_a_light_as_the_others_have():
    """Three samples of noise, which alone would be fitted by a light of 0.2."""
    start = Start(views(0.1 * changing()))
    few = (start.samples.view != 7).clone()
    hidden = (BASIS.reshape(-1, 3)[start.samples.pixel, 0] > 0.5) & ~few
    few[hidden.nonzero()[:3, 0]] = True
    kept = {name: getattr(start.samples, name)[few] for name in ("point", "pixel", "color", "view")}
    kept["color"] = kept["color"] + 0.03 * torch.randn(kept["color"].shape, generator=torch.Generator().manual_seed(8))
    kept["color"][kept["view"] == 7] += torch.tensor([0.06, -0.06, 0.06])
    samples = replace(start.samples, **kept, patch=None)
    found = light_of_samples(samples, true_estimate(start), BASIS, VIEWS)
    others = torch.cat([found[:7], found[8:]])
    assert (found[7].abs() < 3 * others.square().mean(dim=0).sqrt()).all()
    assert (light_of_samples(start.samples, start.found, torch.zeros_like(BASIS), VIEWS) == 0).all()


def test_behind_a_falloff_light_is_found_all_the_same():
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    falloff = (1 - 0.3 * (rows.square() + columns.square()))[..., None]
    darkened = [replace(v, image=(v.image * falloff).round().to(torch.uint8)) for v in views(changing())]
    start = Start(darkened)
    found = light_of_samples(start.samples, true_estimate(start, falloff), BASIS, VIEWS)
    assert rms(found - linear(changing())) < 0.02


def test_samples_and_guide_become_those_of_constant_light():
    lit, plain = Start(views(changing())), Start(views(CONSTANT))
    own = linear(changing())
    samples = in_mean_light(lit.samples, true_estimate(lit), BASIS, own)
    order = samples.point.double() * 10 + samples.color.double().sum(dim=-1)
    assert (order.diff() > -1e-6).all(), "by point, then by brightness"
    place = torch.argsort(samples.point * VIEWS + samples.view)
    same = torch.argsort(plain.samples.point * VIEWS + plain.samples.view)
    inside = plain.samples.pixel[same] % WIDTH < WIDTH // 3 - 2
    before = torch.argsort(lit.samples.point * VIEWS + lit.samples.view)
    difference = samples.color[place] - plain.samples.color[same]
    assert rms(difference[inside]) < 0.2 * rms((lit.samples.color[before] - plain.samples.color[same])[inside])
    outside = plain.samples.pixel[same] % WIDTH > WIDTH // 3 + 1
    assert torch.equal(samples.color[place][outside], lit.samples.color[before][outside])
    addition = finger()[1]
    guide = lit.guide.clone()
    guide[:5, :, 3] = UNKNOWN_DEVIATION
    steady = guide_in_mean_light(guide, BASIS, addition, own)
    assert (steady[:5, :, 3] == UNKNOWN_DEVIATION).all()
    torch.testing.assert_close(steady[..., :3], guide[..., :3])
    hidden = slice(5, None), slice(0, WIDTH // 3 - 2), 3
    # Not all of it: in so few photos light and scene are correlated by chance.
    assert rms(steady[hidden] - plain.guide[hidden]) < 0.65 * rms(guide[hidden] - plain.guide[hidden])
    less = guide_in_mean_light(torch.zeros_like(guide), BASIS, addition, own)
    assert (less[..., 3] == 0).all(), "rounded photos may vary less"
