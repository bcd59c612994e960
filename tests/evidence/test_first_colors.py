"""First colors of points, which are partly seen through an artifact."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ssa_nerfstudio.evidence.first_colors import first_colors
from ssa_nerfstudio.evidence.point_samples import PointSamples

HEIGHT, WIDTH = 36, 48
BRIGHTEST = 0.6
"""Of the scene."""


def disc(radius: float) -> Tensor:
    """[H, W] bool."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    return torch.hypot(x - 0.2, y) < radius


@pytest.mark.parametrize(("through", "beside"), [(0.0, 0), (0.0, 4), (0.2, 4), (0.4, 0), (0.4, 4), (0.6, 4)])
def test_samples_start_by_how_much_comes_through_where_they_are(through: float, beside: int) -> None:
    """Some points are seen behind a dark mark but for few photos, which tell their colors, or but for none.

    Where less than a third of the scene comes through, the few have the word, and where less than a half, samples are
    compared with the photos' mean. All others go by the median of what the photos show.
    """
    generator = torch.Generator().manual_seed(0)
    views, points, dark = 60, 300, torch.tensor([0.05, 0.1, 0.15])
    mark, clear = disc(0.4), disc(0.7)  # no window holds samples of both
    marked, unmarked = mark.flatten().nonzero()[:, 0], (~clear).flatten().nonzero()[:, 0]
    colors = BRIGHTEST * torch.rand(points, 3, generator=generator)
    point, view = torch.arange(points).repeat_interleave(views), torch.arange(views).repeat(points)
    behind = torch.where(point % 30 == 0, view >= beside, view % 4 == 0)
    places = [each[torch.randint(len(each), (len(point),), generator=generator)] for each in (marked, unmarked)]
    shown = torch.where(behind[:, None], through * colors[point] + (1 - through) * dark, colors[point])
    shown = (shown + 0.01 * torch.randn(shown.shape, generator=generator)).clamp(0, 1)
    pixel = torch.where(behind, *places)
    samples = PointSamples(point, pixel, shown, points, (HEIGHT, WIDTH), view).ordered()
    mean, deviation = torch.full((HEIGHT, WIDTH, 3), BRIGHTEST / 2), torch.full((HEIGHT, WIDTH, 1), 0.17)
    mean[mark] = through * BRIGHTEST / 2 + (1 - through) * dark
    deviation[mark] *= max(through, 0.05)
    first, residual = first_colors(samples, mean, deviation, None)
    expected = colors.clone()
    if through > 1 / 3 or not beside:
        expected[::30] = through * colors[::30] + (1 - through) * dark
    torch.testing.assert_close(first, expected, atol=0.1, rtol=0)
    opaque, behind = samples.color - mean.reshape(-1, 3)[samples.pixel], mark.flatten()[samples.pixel]
    hiding = behind[:, None] & torch.tensor(through < 0.5)
    torch.testing.assert_close(residual, torch.where(hiding, opaque, samples.color - first[samples.point]))


@pytest.mark.parametrize("known", [False, True])
def test_what_always_hides_starts_as_opaque_and_has_no_say_in_the_points_colors(known: bool) -> None:
    """A mark in the colors that the points seem to have, as where these are behind it in nearly all photos."""
    generator = torch.Generator().manual_seed(0)
    mark = disc(0.4)
    marked, others = mark.flatten().nonzero()[:, 0], (~mark).flatten().nonzero()[:, 0]
    points, views = 200, 12
    point, view = torch.arange(points).repeat_interleave(views), torch.arange(views).repeat(points)
    behind = view > 1
    colors, paint = torch.rand(points, 3, generator=generator), torch.rand(points, 3, generator=generator)
    places = [each[torch.randint(len(each), (len(point),), generator=generator)] for each in (marked, others)]
    shown = torch.where(behind[:, None], paint[point], colors[point])
    samples = PointSamples(point, torch.where(behind, *places), shown, points, (HEIGHT, WIDTH), view).ordered()
    mean, deviation = torch.full((HEIGHT, WIDTH, 3), 0.5), torch.full((HEIGHT, WIDTH, 1), 0.17)
    first, residual = first_colors(samples, mean, deviation, mark[..., None] if known else None)
    assert torch.equal(first, colors if known else paint)
    inside = mark.flatten()[samples.pixel]
    torch.testing.assert_close(residual[inside], (samples.color - (0.5 if known else first[samples.point]))[inside])
