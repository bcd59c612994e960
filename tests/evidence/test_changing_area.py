"""The area of an artifact that changes from photo to photo, from layers whose unexplained samples are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssa_nerfstudio.evidence.changing_area import changing_area, moving_parts
from ssa_nerfstudio.evidence.initialization import ignore_changing
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate, estimate_layers
from ssa_nerfstudio.evidence.point_samples import PointSamples
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay

HEIGHT, WIDTH = 40, 60
BLOB = slice(24, 36), slice(20, 34)
PAINT = torch.tensor([0.9, 0.4, 0.1])


def estimated(opacity: float, unexplained: float, usual: float = 0.1) -> LayerEstimate:
    """A clear frame with some unexplained samples everywhere, and a blob."""
    hidden = torch.zeros(HEIGHT, WIDTH, 1)
    hidden[BLOB] = opacity
    generator = torch.Generator().manual_seed(0)
    outliers = usual * torch.rand(HEIGHT, WIDTH, 1, generator=generator)
    outliers[BLOB] = unexplained
    ones = torch.ones_like(hidden)
    return LayerEstimate(1 - hidden, torch.zeros(HEIGHT, WIDTH, 3), ones, outliers)


def test_an_artifact_that_the_layers_do_not_explain_changes_and_its_rim_belongs_to_it() -> None:
    found = changing_area(estimated(0.8, 0.4))
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[22:38, 18:36] = True
    assert (found == expected).all()


def test_what_changes_in_a_part_changes_as_a_whole_but_for_what_lets_most_of_the_scene_through() -> None:
    part = estimated(0.8, 0.4)
    part.unexplained[24:36, 26:34] = 0.05  # plain: it looks the same wherever it is
    assert (changing_area(part) == changing_area(estimated(0.8, 0.4))).all()
    part.transmittance[24:36, 30:34] = 0.6
    part.transmittance[4:12, 44:56] = 0.2  # another one, which stands still
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[22:38, 18:32] = True
    assert (changing_area(part) == expected).all()


def test_what_changes_may_let_most_of_the_scene_through_in_places() -> None:
    soft = estimated(0.8, 0.4)
    soft.transmittance[24:36, 20:22] = 0.6
    assert (changing_area(soft) == changing_area(estimated(0.8, 0.4))).all()


@pytest.mark.parametrize(
    ("opacity", "unexplained"),
    [(0.8, 0.05), (0.3, 0.4), (0.05, 0.4), (0.0, 0.0)],
    ids=["explained", "hides little", "noise", "nothing"],
)
def test_what_is_explained_or_hides_little_does_not(opacity: float, unexplained: float) -> None:
    assert not changing_area(estimated(opacity, unexplained)).any()


def test_pixels_without_samples_say_nothing_of_what_is_usual() -> None:
    """A blob whose share of outliers others have, too, in a frame of which few pixels have samples."""
    few = estimated(0.8, 0.09)
    few.unexplained[torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)) < 0.9] = torch.nan
    few.unexplained[BLOB] = 0.09
    assert not changing_area(few).any()
    few.unexplained[few.opacity() < 0.5] = torch.nan
    assert not changing_area(few).any()


def test_what_is_unexplained_everywhere_is_no_artifacts_doing() -> None:
    assert not changing_area(estimated(0.8, 0.4, usual=0.6)).any()
    ones = torch.ones(HEIGHT, WIDTH, 1)
    assert not changing_area(LayerEstimate(0 * ones, torch.zeros(HEIGHT, WIDTH, 3), ones, ones)).any()


def test_samples_of_what_sways_are_unexplained_and_those_of_what_stands_still_are_not() -> None:
    generator = torch.Generator().manual_seed(0)
    views, points = 30, 400
    color = 0.2 + 0.6 * torch.rand(points, 3, generator=generator)
    way = 0.5 * (torch.rand(points, views, 2, generator=generator) - 0.5)
    place = torch.rand(points, 1, 2, generator=generator) + way
    place = (place * torch.tensor([HEIGHT, WIDTH])).long()
    inside = ((place >= 0) & (place < torch.tensor([HEIGHT, WIDTH]))).all(dim=-1)
    point, view = inside.nonzero(as_tuple=True)
    row, column = place[inside].unbind(dim=-1)
    # Two opaque ones: one sways to the side in every other photo, the other stands still.
    sways = (row >= 24) & (row < 36) & (column >= 16 + 10 * (view % 2)) & (column < 30 + 10 * (view % 2))
    stands = (row >= 4) & (row < 14) & (column >= 40) & (column < 52)
    shown = torch.where((sways | stands)[:, None], PAINT, color[point])
    samples = PointSamples(point, row * WIDTH + column, shown, points, (HEIGHT, WIDTH), view).ordered()
    mean = torch.full((HEIGHT, WIDTH, 3), 0.5)
    deviation = torch.full((HEIGHT, WIDTH, 1), 0.15)
    for still in ((slice(24, 36), slice(26, 30)), (slice(4, 14), slice(40, 52))):
        mean[still], deviation[still] = PAINT, 0.01
    nowhere = torch.zeros(HEIGHT, WIDTH, 1)
    unexplained = estimate_layers(samples, mean, deviation, nowhere, nowhere).unexplained[..., 0]
    assert unexplained[26:34, 18:24].mean() > 0.3
    assert unexplained[6:12, 42:50].mean() < 0.05
    assert unexplained[5:20, 5:35].mean() < 0.05


Part = tuple[int, int, int, int]
"""Rows from and to, columns from and to."""
NOISE = 0.05
"""Of all samples."""
STILL, MOVES = 0.02, 0.07
"""Deviation from the layers behind what stands still and of what moves."""


def in_parts(
    parts: dict[Part, float], opacity: float = 0.8, samples_of_pixel: int = 6
) -> tuple[LayerEstimate, PointSamples]:
    """Layers of parts in a frame behind a falloff, and samples that deviate from them, without it, by these numbers."""
    generator = torch.Generator().manual_seed(5)
    hidden, deviation = torch.zeros(HEIGHT, WIDTH, 1), torch.full((HEIGHT, WIDTH, 1), NOISE)
    for (top, bottom, left, right), own in parts.items():
        hidden[top:bottom, left:right], deviation[top:bottom, left:right] = opacity, own
    falloff = torch.linspace(1, 0.6, WIDTH).expand(HEIGHT, WIDTH)[..., None].contiguous()
    colors = torch.rand(500, 3, generator=generator)
    ones, addition = torch.ones_like(hidden), hidden * PAINT
    found = LayerEstimate(1 - hidden, addition, falloff, 0 * ones, torch.tensor(NOISE), colors)
    pixel = torch.arange(HEIGHT * WIDTH).repeat(samples_of_pixel)
    point = torch.randint(500, pixel.shape, generator=generator)
    shown = (1 - hidden).reshape(-1, 1)[pixel] * colors[point] + addition.reshape(-1, 3)[pixel]
    shown = shown + deviation.reshape(-1, 1)[pixel] * torch.randn(shown.shape, generator=generator)
    shown = falloff.reshape(-1, 1)[pixel] * shown
    return found, PointSamples(point, pixel, shown, 500, (HEIGHT, WIDTH), torch.zeros_like(pixel))


def area(*parts: Part, wider: int = 2) -> np.ndarray:
    found = np.zeros((HEIGHT, WIDTH), bool)
    for top, bottom, left, right in parts:
        found[top - wider : bottom + wider, left - wider : right + wider] = True
    return found


LEFT_PART, RIGHT_PART = (4, 14, 6, 18), (24, 34, 44, 56)
SPOT, LARGER_SPOT = (20, 25, 8, 17), (20, 26, 8, 18)
"""1.9 and 2.5 % of the frame."""


@pytest.mark.parametrize(
    ("parts", "moving"),
    [
        ({LEFT_PART: MOVES, RIGHT_PART: STILL}, [LEFT_PART]),
        ({LEFT_PART: STILL, RIGHT_PART: MOVES}, [RIGHT_PART]),
        ({LEFT_PART: MOVES, RIGHT_PART: MOVES}, [LEFT_PART, RIGHT_PART]),
        ({SPOT: MOVES}, []),
        ({LARGER_SPOT: MOVES}, [LARGER_SPOT]),
    ],
    ids=["left", "right", "both", "of a spot errors may be the reason", "no spot"],
)
def test_a_part_moves_if_its_samples_deviate_more_than_a_scene_behind_it_could_and_its_rim_belongs_to_it(
    parts: dict[Part, float], moving: list[Part]
) -> None:
    assert (moving_parts(*in_parts(parts)) == area(*moving)).all()


def test_parts_that_touch_by_a_corner_are_one() -> None:
    halves = {(20, 25, 8, 16): MOVES, (25, 30, 16, 24): MOVES}
    assert moving_parts(*in_parts(halves))[20:25, 8:16].all()


def test_what_lets_half_of_the_scene_through_does_not_move_unless_it_is_bright() -> None:
    assert not moving_parts(*in_parts({LEFT_PART: MOVES}, 0.45)).any()
    assert moving_parts(*in_parts({LEFT_PART: MOVES}, 0.55)).any()
    found, samples = in_parts({LEFT_PART: MOVES}, 0.45)
    inside = torch.from_numpy(area(LEFT_PART, wider=0))
    found.addition[inside] += 0.2
    samples.color.add_((0.2 * inside[..., None] * found.falloff).reshape(-1, 1)[samples.pixel])
    assert moving_parts(found, samples).any()


@pytest.mark.parametrize(("number", "moves"), [(0, False), (49, False), (50, True)])
def test_few_samples_say_nothing(number: int, moves: bool) -> None:
    found, samples = in_parts({LEFT_PART: 2 * MOVES})
    inside = torch.from_numpy(area(LEFT_PART, wider=0)).flatten()[samples.pixel]
    kept = ~inside
    kept[inside.nonzero()[:number, 0]] = True
    fewer = {name: getattr(samples, name)[kept] for name in ("point", "pixel", "color", "view")}
    assert moving_parts(found, replace(samples, **fewer)).any() == moves


@pytest.mark.parametrize(("noise", "moves"), [(0.11, False), (0.09, True)])
def test_a_scene_of_more_noise_explains_more(noise: float, moves: bool) -> None:
    """The squares of 0.07 are half of those of 0.1."""
    found, samples = in_parts({RIGHT_PART: MOVES})
    assert moving_parts(replace(found, noise=torch.tensor(noise)), samples).any() == moves


def test_rounding_is_no_movement() -> None:
    found, samples = in_parts({LEFT_PART: 0.0})
    samples.color.add_(0.5 / 255)
    assert not moving_parts(replace(found, noise=torch.tensor(1 / 255)), samples).any()


def test_the_scene_learns_neither_where_samples_are_unusual_nor_where_a_part_moves() -> None:
    found, samples = in_parts({LEFT_PART: STILL, RIGHT_PART: MOVES})
    found.unexplained[torch.from_numpy(area(LEFT_PART, wider=0))] = 0.4
    for moving, parts in ((None, [LEFT_PART]), (samples, [LEFT_PART, RIGHT_PART])):
        overlay = ScreenSpaceOverlay(HEIGHT, WIDTH)
        ignore_changing(overlay, found, moving)
        assert (overlay.reliable[..., 0].numpy() == ~area(*parts)).all()
    overlay = ScreenSpaceOverlay(HEIGHT, WIDTH)
    ignore_changing(overlay, *in_parts({LEFT_PART: STILL}))
    assert overlay.reliable.shape == (1, 1, 1)
