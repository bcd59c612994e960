"""Layers estimated from the scene's points: synthetic scenes whose artifact is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from ssa_nerfstudio.evidence import layer_estimate
from ssa_nerfstudio.evidence.layer_estimate import (
    SMOOTHNESS_FLOOR,
    LayerEstimate,
    _photo_differences,
    _smoothness,
    estimate_layers,
)
from ssa_nerfstudio.evidence.point_samples import PointSamples
from ssa_nerfstudio.evidence.present_area import present_area

HEIGHT, WIDTH = 36, 48
BRIGHTEST = 0.6
"""Of the scene, so that added light is not clipped."""
NOWHERE = torch.zeros(HEIGHT, WIDTH, 1)
EVERYWHERE = NOWHERE == 0


def disc(softness: float = 0.1, radius: float = 0.5) -> Tensor:
    """[H, W, 1]: 1 in a disc, 0 outside."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    return torch.sigmoid((radius - torch.hypot(x - 0.2, y)) / softness)[..., None]


def hatching() -> Tensor:
    """[H, W, 1]: thin diagonal strokes."""
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return ((x + 2 * y) % 9 < 2).float()[..., None]


def vignette() -> Tensor:
    y, x = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    return 0.5 * ((x * x + y * y - 0.4).clamp_min(0) / 1.6)[..., None]


def film(matte: Tensor, color: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    return 1 - matte, matte * torch.tensor(color)


ARTIFACTS = {
    "opaque and soft": film(disc(), (0.8, 0.4, 0.3)),
    "opaque and plain in the scene's mean color": film(disc(0.02), (0.3, 0.3, 0.3)),
    "translucent": film(0.5 * disc(0.02), (1.0, 1.0, 1.0)),
    "multiplicative": film(vignette(), (0.0, 0.0, 0.0)),
    "additive": (torch.ones(HEIGHT, WIDTH, 1), 0.4 * hatching().expand(-1, -1, 3)),
    "none": film(torch.zeros(HEIGHT, WIDTH, 1), (0.0, 0.0, 0.0)),
}


def observe(
    transmittance: Tensor, addition: Tensor, views: int = 60, points: int = 600, wrong: float = 0.1, seed: int = 0
) -> tuple[PointSamples, Tensor, Tensor]:
    """Random points at random pixels; some samples show something else. And the photos' mean and deviation."""
    generator = torch.Generator().manual_seed(seed)
    colors = BRIGHTEST * torch.rand(points, 3, generator=generator)
    point = torch.arange(points).repeat(views)
    pixel = torch.randint(HEIGHT * WIDTH, (len(point),), generator=generator)
    behind = colors[point]
    hidden = torch.rand(len(point), generator=generator) < wrong
    behind[hidden] = BRIGHTEST * torch.rand(int(hidden.sum()), 3, generator=generator)
    seen = transmittance.reshape(-1, 1)[pixel] * behind + addition.reshape(-1, 3)[pixel]
    seen = (seen + 0.02 * torch.randn(seen.shape, generator=generator)).clamp(0, 1)
    order = np.lexsort((seen.sum(dim=-1).numpy(), point.numpy()))
    view = torch.arange(views).repeat_interleave(points)[order]
    samples = PointSamples(point[order], pixel[order], seen[order], points, (HEIGHT, WIDTH), view)
    photos = transmittance * BRIGHTEST * torch.rand(200, HEIGHT, WIDTH, 3, generator=generator) + addition
    return samples, photos.mean(dim=0), photos.std(dim=0).amax(dim=-1, keepdim=True)


@pytest.mark.parametrize("name", ARTIFACTS)
def test_layers_come_out_without_an_edge_or_a_decision_of_kind(name: str) -> None:
    transmittance, addition = ARTIFACTS[name]
    found = estimate_layers(*observe(transmittance, addition), NOWHERE, NOWHERE)
    assert (found.transmittance - transmittance).abs().mean() < 0.04
    assert (found.addition - addition).abs().mean() < 0.03
    assert found.adds_light(present_area(found.opacity())) == (name == "additive")
    present = torch.maximum(1 - transmittance, addition.amax(dim=-1, keepdim=True)) > 0.3
    assert found.share() == pytest.approx(float(present.float().mean()), abs=0.03)


@pytest.mark.parametrize(("hidden", "color"), [(0.0, 0.1), (0.9, 0.1), (0.9, 0.01)])
def test_bright_details_beside_what_hides_add_light_and_that_still_hides(hidden: float, color: float) -> None:
    """Text of which too few points are seen to tell what it hides, alone and beside a soft, dark thumb."""
    thumb = hidden * disc()
    text = torch.zeros(HEIGHT, WIDTH, 1)
    text[30:33, 2:20:3] = 0.2
    layers = LayerEstimate(
        1 - thumb, torch.maximum(text, color * thumb).expand(-1, -1, 3), torch.ones_like(thumb), 0 * thumb
    )
    assert layers.adds_light(EVERYWHERE)
    assert torch.equal(layers.hides(), thumb > 0.5)


@pytest.mark.parametrize(("added", "dark", "adds"), [(0.4, 0, True), (0.25, 0, False), (1, 12, True), (1, 28, False)])
def test_light_is_added_from_a_third_of_the_light_on_and_beside_what_hides_little(
    added: float, dark: int, adds: bool
) -> None:
    """Text that also hides, and a black film above it: squares of 0.72 beside a hundredth of 0, 52 and 121."""
    text = torch.zeros(HEIGHT, WIDTH, 1)
    text[30:33, 2:20:3] = 0.2
    transmittance = 1 - (1 - added) * text
    transmittance[:dark] = 0.7
    layers = LayerEstimate(transmittance, text.expand(-1, -1, 3), torch.ones_like(text), torch.zeros_like(text))
    assert layers.adds_light(EVERYWHERE) == adds


@pytest.mark.parametrize("rain", [False, True])
def test_drops_add_light_beside_a_dashboard_whose_bright_gauges_do_not(rain: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    transmittance, addition = torch.ones(HEIGHT, WIDTH, 1), torch.zeros(HEIGHT, WIDTH, 3)
    addition[:-12] = 0.4 * rain * (torch.rand(HEIGHT - 12, WIDTH, 1, generator=generator) < 0.2)
    transmittance[-12:], addition[-12:] = 0.02, 0.2
    addition[-12:, ::4] = 0.9
    layers = LayerEstimate(transmittance, addition, torch.ones_like(transmittance), torch.zeros_like(transmittance))
    assert layers.adds_light(EVERYWHERE) == rain


def test_a_film_of_errors_does_not_let_a_dark_panel_add_light() -> None:
    """A plain black panel has no light at all, so that all light is the film's, which errors make elsewhere."""
    generator = torch.Generator().manual_seed(0)
    transmittance, addition = torch.ones(HEIGHT, WIDTH, 1), torch.zeros(HEIGHT, WIDTH, 3)
    transmittance[-10:] = 0.4
    addition[:20] = 0.08 + 0.1 * torch.rand(20, WIDTH, 1, generator=generator)
    layers = LayerEstimate(transmittance, addition, torch.ones_like(transmittance), torch.zeros_like(transmittance))
    assert layers.adds_light(EVERYWHERE)
    area = present_area(layers.opacity())
    assert area[-10:].all()
    assert not area[:20].any()
    assert not layers.adds_light(area)


def test_points_that_are_never_seen_clearly_do_not_vouch_for_themselves() -> None:
    """Half of the points are always behind the disc, where they have its color in every view."""
    transmittance, addition = ARTIFACTS["opaque and soft"]
    samples, mean, deviation = observe(transmittance, addition, wrong=0.0)
    inside = disc().flatten()[samples.pixel] > 0.99
    generator = torch.Generator().manual_seed(1)
    places = (disc().flatten() > 0.99).nonzero()[:, 0]
    stuck = (samples.point % 2 == 0) & ~inside
    pixel, color = samples.pixel.clone(), samples.color.clone()
    pixel[stuck] = places[torch.randint(len(places), (int(stuck.sum()),), generator=generator)]
    color[stuck] = addition.reshape(-1, 3)[pixel[stuck]]
    moved = replace(samples, pixel=pixel, color=color)
    found = estimate_layers(moved, mean, deviation, NOWHERE, NOWHERE)
    assert (found.transmittance - transmittance)[disc() > 0.99].abs().mean() < 0.1


def where(samples: PointSamples, kept: Tensor) -> PointSamples:
    """The samples at pixels where `kept` [H, W, 1] is True."""
    kept = kept.flatten()[samples.pixel]
    return replace(samples, **{name: getattr(samples, name)[kept] for name in ("point", "pixel", "color", "view")})


def test_what_hides_most_of_the_frame_softly_is_no_outlier() -> None:
    """An operator below a 360 camera: half of all samples show him, and none of them what is behind."""
    transmittance, addition = film(disc(0.05, radius=0.9), (0.25, 0.2, 0.15))
    found = estimate_layers(*observe(transmittance, addition, views=14, points=50), NOWHERE, NOWHERE)
    assert found.transmittance[transmittance < 0.1].mean() < 0.05
    assert found.transmittance[transmittance > 0.9].mean() > 0.95


def test_a_calm_area_that_hides_the_scene_wherever_points_tell_hides_it_everywhere() -> None:
    """Points are seen near the rim of the disc alone."""
    transmittance, addition = film(disc(0.02), (0.25, 0.2, 0.15))
    samples, mean, deviation = observe(transmittance, addition, views=14, points=50)
    core = disc(0.02, radius=0.3) > 0.5
    found = estimate_layers(where(samples, ~core), mean, deviation, NOWHERE, NOWHERE)
    assert found.transmittance[core].mean() < 0.05


@pytest.mark.parametrize(("floors", "share", "change"), [(100, 0.2, 0.2), (300, 0.3, 0.165)])
def test_a_thumb_in_changing_light_leaves_a_plain_floor_beside_it_clear(
    floors: int, share: float, change: float
) -> None:
    """The thumb varies more than the floor: by the photos' variance alone the floor's points would have its color.

    Where it often hides many of these points, one turn of colors and hiding pixels leaves half of them with it.
    """
    generator = torch.Generator().manual_seed(0)
    views, walls = 60, 500
    colors = torch.cat([BRIGHTEST * torch.rand(walls, 3, generator=generator), torch.full((floors, 3), 0.2)])
    colors[walls:] += 0.15 * torch.rand(floors, 3, generator=generator)
    thumb, floor = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool), torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    thumb[12:, 32:], floor[24:, 16:32] = True, True
    behind, beside, elsewhere = (each.flatten().nonzero()[:, 0] for each in (thumb, floor, ~floor))
    point, view = torch.arange(walls + floors).repeat(views), torch.arange(views).repeat_interleave(walls + floors)
    hidden = torch.rand(len(point), generator=generator) < share
    places = [
        each[torch.randint(len(each), (len(point),), generator=generator)] for each in (behind, beside, elsewhere)
    ]
    pixel = torch.where(hidden, places[0], torch.where(point < walls, places[2], places[1]))
    light = 1 + change * torch.randn(views, 1, generator=generator)
    shown = torch.where(thumb.flatten()[pixel][:, None], torch.tensor([0.6, 0.4, 0.3]) * light[view], colors[point])
    shown = (shown + 0.01 * torch.randn(shown.shape, generator=generator)).clamp(0, 1)
    order = np.lexsort((shown.sum(dim=-1).numpy(), point.numpy()))
    samples = PointSamples(point[order], pixel[order], shown[order], walls + floors, (HEIGHT, WIDTH), view[order])
    mean = torch.full((HEIGHT, WIDTH, 3), BRIGHTEST / 2)
    mean[thumb], mean[floor] = torch.tensor([0.6, 0.4, 0.3]), 0.275
    deviation = torch.full((HEIGHT, WIDTH, 1), 0.17)
    deviation[thumb], deviation[floor] = 0.6 * change, 0.045
    found = estimate_layers(samples, mean, deviation, NOWHERE, NOWHERE)
    assert found.transmittance[thumb].mean() < 0.1
    assert found.transmittance[floor].mean() > 0.9


def test_a_film_over_a_plain_part_of_the_scene_is_not_taken_for_opaque() -> None:
    """A path that stays in the middle of the frame, all of one color: photos hardly vary there, yet it is seen."""
    plain, color, through = disc(0.02)[..., 0] > 0.5, torch.tensor([0.4, 0.35, 0.3]), 0.8
    samples, mean, deviation = observe(*film(torch.full((HEIGHT, WIDTH, 1), 1 - through), (0.2, 0.2, 0.2)), wrong=0.0)
    seen = plain.flatten()[samples.pixel]
    generator = torch.Generator().manual_seed(2)
    noise = 0.02 * torch.randn(len(seen), 3, generator=generator)
    shown = through * color + (1 - through) * 0.2
    # Points of the path are others than those beside it.
    point = torch.where(seen, samples.points + samples.point, samples.point)
    observed = torch.where(seen[:, None], shown + noise, samples.color)
    order = np.lexsort((observed.sum(dim=-1).numpy(), point.numpy()))
    path = PointSamples(
        point[order], samples.pixel[order], observed[order], 2 * samples.points, samples.size, samples.view[order]
    )
    mean[plain], deviation[plain] = shown, 0.02
    found = estimate_layers(path, mean, deviation, NOWHERE, NOWHERE)
    assert found.transmittance[plain].min() > 0.6


def test_without_samples_the_layers_are_as_expected() -> None:
    """A pixel that no point was seen at takes what its surroundings say, or else what is expected: opaque."""
    hidden = NOWHERE.clone()
    hidden[:, :20] = 1
    samples, *_ = observe(*ARTIFACTS["none"])
    part = where(samples, (torch.arange(WIDTH) >= 24).expand(HEIGHT, WIDTH))
    mean = torch.full((HEIGHT, WIDTH, 3), 0.5)
    mean[:, :20] = torch.tensor([0.3, 0.2, 0.1])
    found = estimate_layers(part, mean, torch.full((HEIGHT, WIDTH, 1), 0.3), hidden, NOWHERE)
    assert found.transmittance[:, :16].max() < 0.2
    assert found.transmittance[:, 30:].min() > 0.8
    assert found.unexplained[:, :16].isnan().all()
    assert not found.unexplained[:, 30:].isnan().any()


def strip(samples: PointSamples, every: int) -> PointSamples:
    """Few of the samples in the lowest rows, all others."""
    below = samples.pixel // WIDTH >= 28
    kept = ~below | (torch.arange(len(below)) % every == 0)
    return replace(samples, **{name: getattr(samples, name)[kept] for name in ("point", "pixel", "color", "view")})


@pytest.mark.parametrize("through", [0.0, 0.4, 1.0])
def test_what_few_samples_show_behind_static_edges_holds_for_all_of_the_part(through: float) -> None:
    """A bonnet along the bottom that mirrors the scene: no area is calm, and a dozen points are seen behind it.

    Where edges stand still though nothing is there (through = 1), samples say so.
    """
    static = NOWHERE.clone()
    static[28:] = 1
    color = torch.tensor([0.5, 0.4, 0.35])
    transmittance = 1 - (1 - through) * static
    samples, mean, deviation = observe(transmittance, (1 - transmittance) * color, wrong=0.0)
    mirrored = 0.1 * (torch.rand(samples.color.shape, generator=torch.Generator().manual_seed(5)) - 0.5)
    seen = samples.color + (1 - transmittance).reshape(-1, 1)[samples.pixel] * mirrored
    samples = strip(replace(samples, color=seen.clamp(0, 1)).ordered(), every=300)
    assert 8 <= int((samples.pixel // WIDTH >= 28).sum()) <= 60
    deviation = deviation.clamp_min(0.1)
    found = estimate_layers(samples, mean, deviation, NOWHERE, static)
    assert found.transmittance[30:].mean() == pytest.approx(through, abs=0.2)
    if through == 0:
        unknown = estimate_layers(samples, mean, deviation, NOWHERE, NOWHERE)
        assert unknown.transmittance[30:].mean() > 0.4


@pytest.mark.parametrize("seed", [0, 1])
def test_any_number_of_samples_gives_finite_layers(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for count in (1, 2, 30):
        point = torch.randint(5, (count,), generator=generator).sort().values
        pixel = torch.randint(HEIGHT * WIDTH, (count,), generator=generator)
        samples = PointSamples(point, pixel, torch.rand(count, 3, generator=generator), 5, (HEIGHT, WIDTH), point)
        flat = torch.full((HEIGHT, WIDTH, 3), 0.5)
        found = estimate_layers(samples, flat, NOWHERE, NOWHERE, NOWHERE)
        for layer in (found.transmittance, found.addition):
            assert torch.isfinite(layer).all()
            assert layer.min() >= 0
            assert layer.max() <= 1


@pytest.mark.parametrize(("opacity", "ratio"), [(0.0, 1.0), (0.5, 2.0), (1.0, 3.0)])
def test_neighboring_layers_differ_as_the_photos_do_and_more_where_something_hides(
    opacity: float, ratio: float
) -> None:
    """From left to right: nothing differs; the mean does, by half of white in one channel; the deviation doubles.

    A contrast of a third makes an edge of T three times as high as that of the mean.
    """
    mean, deviation = torch.full((3, 4, 3), 0.2), torch.full((3, 4, 1), 0.1)
    mean[:, 2:, 1] = 0.7
    deviation[:, 3:] = 0.2
    there = torch.full((3, 4, 1), opacity)
    precision = _smoothness(_photo_differences(mean, deviation, 1), there, 1)
    assert precision.shape == (3, 3, 4)
    floor = SMOOTHNESS_FLOOR**2
    torch.testing.assert_close(precision[0, 0], torch.full((4,), 1 / floor))
    torch.testing.assert_close(precision[1, 1], torch.full((4,), 1 / (floor + (ratio * 0.5) ** 2)))
    torch.testing.assert_close(precision[2, 2], torch.tensor([1 / (floor + ratio**2), *[1 / floor] * 3]))
    assert (_smoothness(_photo_differences(mean, deviation, 0), there, 0) == 1 / floor).all()


def test_an_edge_of_an_artifact_may_be_as_high_as_its_opaque_side_allows() -> None:
    mean, deviation = torch.full((1, 3, 3), 0.2), torch.full((1, 3, 1), 0.1)
    mean[:, 1:] = 0.7
    side = torch.tensor([0.0, 1.0, 0.0])[None, :, None]
    left, right = _smoothness(_photo_differences(mean, deviation, 1), side, 1)[0, :, 1]
    torch.testing.assert_close(left, torch.tensor(1 / (SMOOTHNESS_FLOOR**2 + 1.5**2)))
    assert right == 1 / SMOOTHNESS_FLOOR**2
    mirrored = _smoothness(_photo_differences(mean, deviation, 1), 1 - side, 1)
    assert torch.equal(mirrored[0, 0, 1], left), "either neighbor may be the opaque one"


@pytest.mark.parametrize("seed", [0, 1])
def test_layers_are_sharper_on_an_artifact_than_in_the_clear(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Gray strokes of little contrast in front of a textured scene that few photos show.

    If layers may nowhere differ by more than the photos, the strokes are smoothed away; if they may everywhere, noise
    in the clear stays.
    """
    transmittance, addition = film(0.9 * hatching(), (0.35, 0.35, 0.35))
    samples, mean, deviation = observe(transmittance, addition, views=20, points=300, seed=seed)
    texture = torch.rand(HEIGHT, WIDTH, 1, generator=torch.Generator().manual_seed(5))
    mean += 0.2 * texture * transmittance

    def errors() -> tuple[float, float]:
        found = estimate_layers(samples, mean, deviation, NOWHERE, NOWHERE)
        error, present = (found.transmittance - transmittance).abs(), transmittance < 0.9
        return float(error[present].mean()), float(error[~present].mean())

    def errors_with(opacity: float) -> tuple[float, float]:
        def everywhere(differences: Tensor, known: Tensor, dimension: int) -> Tensor:
            return _smoothness(differences, torch.full_like(known, opacity), dimension)

        with monkeypatch.context() as patched:
            patched.setattr(layer_estimate, "_smoothness", everywhere)
            return errors()

    there, clear = errors()
    assert there < 0.75 * errors_with(0.0)[0]
    assert clear < 0.75 * errors_with(1.0)[1]


def test_light_counts_as_an_artifact_to_the_smoothness(monkeypatch: pytest.MonkeyPatch) -> None:
    known = []

    def recorded(differences: Tensor, opacity: Tensor, dimension: int) -> Tensor:
        known.append(opacity)
        return _smoothness(differences, opacity, dimension)

    monkeypatch.setattr(layer_estimate, "_smoothness", recorded)
    estimate_layers(*observe(*ARTIFACTS["additive"]), NOWHERE, NOWHERE)
    strokes = hatching() > 0
    assert known[0].max() == 0, "nothing is known in the first turn"
    assert known[-1][strokes].mean() > 0.3
    assert known[-1][~strokes].mean() < 0.1


def test_pixels_that_masks_hide_do_not_change_the_smoothness_of_others() -> None:
    """Most of the frame is masked in all photos, so its deviation is unknown."""
    mean, deviation = torch.full((9, 4, 3), 0.2), torch.full((9, 4, 1), 0.1)
    deviation[:, 3:] = 0.2
    masked = deviation.clone()
    masked[3:] = torch.nan
    assert torch.equal(_photo_differences(mean, masked, 1)[:3], _photo_differences(mean, deviation, 1)[:3])
    assert torch.isfinite(_photo_differences(mean, masked, 0)).all()


@pytest.mark.parametrize("masked", [0.0, 0.6])
def test_layers_are_found_beside_a_mask_of_most_of_the_frame(masked: float) -> None:
    """A plain panel in the scene's mean color, whose only edge is that of the deviation."""
    transmittance, addition = ARTIFACTS["opaque and plain in the scene's mean color"]
    samples, mean, deviation = observe(transmittance, addition, wrong=0.0)
    shown = (torch.arange(WIDTH) >= masked * WIDTH).expand(HEIGHT, WIDTH)
    deviation = torch.where(shown[..., None], deviation, torch.nan)
    found = estimate_layers(where(samples, shown), mean, deviation, NOWHERE, NOWHERE)
    assert (found.transmittance - transmittance)[shown].abs().mean() < 0.04
    assert torch.isfinite(found.transmittance).all()
