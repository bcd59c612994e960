"""What the prior of the estimate expects of static parts: samples whose T and B are known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ssa_nerfstudio.evidence.expected_layers import expected_layers
from ssa_nerfstudio.evidence.point_samples import PointSamples

HEIGHT, WIDTH = 30, 40
PART = torch.zeros(HEIGHT, WIDTH, 1)
PART[20:] = 1
NOWHERE = torch.zeros(HEIGHT, WIDTH, 1)
PAINT = torch.tensor([0.5, 0.3, 0.2])
CLEAR = torch.tensor([1.0, 0.0, 0.0, 0.0])


def expected(
    through: float,
    static: Tensor = PART,
    each: int = 40,
    errors: float = 0.0,
    seen: Tensor | None = None,
    sign: int = 1,
) -> Tensor:
    """What is expected where an artifact of this T covers PART; `errors` are those of the points' colors.

    Every pixel has `each` samples, in `seen` [H, W, 1] alone if it is given. `sign` -1: they contradict the colors.
    """
    generator = torch.Generator().manual_seed(0)
    pixel = torch.arange(HEIGHT * WIDTH).repeat(each)
    true = 0.2 + 0.6 * torch.rand(len(pixel), 3, generator=generator)
    transmittance = (1 - (1 - through) * PART).reshape(-1, 1)
    addition = (1 - transmittance) * PAINT
    photos = (transmittance[pixel] * true + addition[pixel]).reshape(each, -1, 3)
    mean = photos.mean(dim=0)
    shown = (mean + sign * (photos - mean)).reshape(-1, 3)
    colors = true + errors * torch.randn(true.shape, generator=generator)
    kept = torch.ones_like(pixel, dtype=torch.bool) if seen is None else seen.flatten()[pixel] > 0
    kept &= torch.rand(len(pixel), generator=generator) < 0.5
    samples = PointSamples(pixel[kept], pixel[kept], shown[kept], HEIGHT * WIDTH, (HEIGHT, WIDTH), pixel[kept])
    deviation = torch.full((HEIGHT, WIDTH, 1), 0.2)
    return expected_layers(samples, colors[kept], mean.reshape(HEIGHT, WIDTH, 3), deviation, NOWHERE, static)


@pytest.mark.parametrize("errors", [0.0, 0.15])
@pytest.mark.parametrize("through", [0.0, 0.2, 0.4])
def test_a_static_part_is_expected_to_let_through_what_its_samples_show(through: float, errors: float) -> None:
    found = expected(through, errors=errors)
    inside = found[20:].reshape(-1, 4)
    assert (inside[:, 0] - through).abs().max() < 0.03
    assert (inside[:, 1:].mean(dim=0) - (1 - through) * PAINT).abs().max() < 0.02
    assert (found[:20] == CLEAR).all()


@pytest.mark.parametrize("through", [0.65, 1.0])
def test_a_part_that_shows_most_of_the_scene_is_expected_to_be_clear(through: float) -> None:
    assert (expected(through) == CLEAR).all()


def test_few_samples_speak_for_all_of_a_part_and_none_for_clear() -> None:
    seen = 1 - PART
    seen[24:26, 10:13] = 1
    assert expected(0.0, seen=seen)[20:, :, 0].max() < 0.05
    assert (expected(0.0, seen=1 - PART) == CLEAR).all()


def test_pixels_without_an_edge_within_a_part_belong_to_it() -> None:
    """And a single edge somewhere else is a part of its own."""
    static = PART.clone()
    static[25, 5:35:3] = 0
    static[5, 5] = 1
    found = expected(0.0, static=static)
    assert found[25, :, 0].max() < 0.05
    assert (found[:20] == CLEAR).all()


def test_samples_that_contradict_their_points_outside_of_all_parts_hide_nothing_there() -> None:
    found = expected(0.2, sign=-1)
    assert torch.isfinite(found).all()
    assert (found[:20] == CLEAR).all()
