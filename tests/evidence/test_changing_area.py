"""The area of an artifact that changes from photo to photo, from layers whose unexplained samples are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssa_nerfstudio.evidence.changing_area import changing_area
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate, estimate_layers
from ssa_nerfstudio.evidence.point_samples import PointSamples

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
