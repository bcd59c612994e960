"""Seeds in gaps between a scene's points: at the depth of what is around, in the photos' colors, and not twice."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from ssa_nerfstudio.evidence.distant_points import Sphere
from ssa_nerfstudio.evidence.gap_points import MAX_VIEWS, NEIGHBORS, SPACING, gap_points
from ssa_nerfstudio.evidence.point_samples import View
from ssa_nerfstudio.evidence.scene_photos import scene_photos
from ssa_nerfstudio.evidence.seeds import Seeds

HEIGHT, WIDTH = 90, 120
K = torch.tensor([[100.0, 0.0, 60.0], [0.0, 100.0, 45.0], [0.0, 0.0, 1.0]])
AT = 4.0
"""Distance of a wall from the cameras, which look along z."""
FAR = Sphere(torch.tensor([1.0, 0.0, 0.0]), 50.0)
"""Behind it."""


def pose(right: float = 0.0, forward: float = 0.0) -> Tensor:
    """World to camera [4, 4]."""
    matrix = torch.eye(4)
    matrix[0, 3], matrix[2, 3] = -right, -forward
    return matrix


def color_of(x: Tensor, y: Tensor) -> Tensor:
    """Of a wall, [..., 3] in [0, 1]."""
    return torch.stack([0.5 + 0.1 * x, 0.5 + 0.1 * y, torch.full_like(x, 0.3)], dim=-1)


def wall_view(matrix: Tensor, **others: Any) -> View:
    """A photo of the wall."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    depth = AT + matrix[2, 3]
    image = color_of((x - 60) / 100 * depth - matrix[0, 3], (y - 45) / 100 * depth)
    return View(image, others.pop("mask", None), matrix, K, **others)


def wall_points(gap: float = 1.0) -> Tensor:
    """Points of the wall, dense but for a square of twice this size."""
    across = torch.linspace(-4, 4, 161)
    points = torch.cartesian_prod(across, across, torch.tensor([AT]))
    return points[points[:, :2].abs().amax(dim=1) > gap]


def filled(points: Tensor, views: list[View], layers: Any = None) -> tuple[Seeds, Seeds]:
    """`gap_points` of views with these layers of an artifact each."""
    return gap_points(points, scene_photos(views, layers or [None] * len(views), [0] * len(views)), FAR)


def gaps(points: Tensor, views: list[View], layers: Any = None) -> Seeds:
    """Those that photos show."""
    return filled(points, views, layers)[0]


def test_a_gap_is_filled_at_the_depth_around_it_in_the_photos_colors() -> None:
    seeds = gaps(wall_points(), [wall_view(pose())])
    across = 2 * 100 / AT / SPACING
    assert 0.6 * across**2 < len(seeds) <= across**2
    assert seeds.positions[:, :2].abs().amax() < 1
    torch.testing.assert_close(seeds.positions[:, 2], torch.full((len(seeds),), AT))
    torch.testing.assert_close(seeds.colors, color_of(*seeds.positions[:, :2].unbind(dim=1)), atol=1e-4, rtol=0)
    nearest = torch.cdist(seeds.positions, seeds.positions).fill_diagonal_(math.inf).amin(dim=1)
    torch.testing.assert_close(seeds.widths, nearest, rtol=1e-3, atol=0)
    assert not len(gaps(wall_points(gap=0.0), [wall_view(pose())])), "there is none"


def test_beyond_the_last_point_nothing_tells_the_depth() -> None:
    """A photo that points cover as far as its middle, with a gap between them, has seeds in the gap alone."""
    points = wall_points()
    assert len(gaps(points[points[:, 0] < 1.3], [wall_view(pose())])) == len(gaps(points, [wall_view(pose())]))
    line = points[(points[:, 1] - 1.5).abs() < 0.01]
    assert not len(gaps(line, [wall_view(pose())])), "nor beside a line"


def test_what_one_photo_has_filled_the_next_ones_leave() -> None:
    """From another place, and from nearer, where it has a larger gap between seeds, too."""
    one = len(gaps(wall_points(), [wall_view(pose())]))
    assert len(gaps(wall_points(), [wall_view(pose())] * 2)) == one
    views = [wall_view(pose()), wall_view(pose(right=0.7)), wall_view(pose(right=-0.7))]
    assert len(gaps(wall_points(), views)) < 1.25 * one
    nearer = gaps(wall_points(), [wall_view(pose()), wall_view(pose(forward=AT / 2))])
    assert len(nearer) > 1.5 * one
    torch.testing.assert_close(nearer.positions[:, 2], torch.full((len(nearer),), AT))


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_floor_is_filled_between_its_sides(angle: float) -> None:
    """Its depth is that of the sides in the same row; cameras have any pose."""
    turn = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]], dtype=torch.float32
    )
    generator = torch.Generator().manual_seed(0)
    pixel = torch.rand(700, 2, generator=generator) * torch.tensor([WIDTH, HEIGHT - 58]) + torch.tensor([0, 58])
    depth = 100 / (pixel[:, 1] - 45)
    points = torch.stack([(pixel[:, 0] - 60) / 100 * depth, torch.ones_like(depth), depth - 0.3], dim=-1)
    points = points[points[:, 0].abs() > 0.6]
    matrix = torch.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, torch.tensor([0.0, 0.0, 0.3])
    below_horizon = (torch.arange(HEIGHT)[:, None] >= 58).float().expand(HEIGHT, WIDTH)
    seeds = gaps(points @ turn, [View(torch.full((HEIGHT, WIDTH, 3), 0.4), below_horizon, matrix, K)])
    assert len(seeds) > 20
    height = seeds.positions @ turn.T
    assert (height[:, 1] - 1).abs().median() < 0.12, "0.17 by the median of eight depths"
    assert height[:, 0].abs().median() < 0.6


@pytest.mark.parametrize("by", ["artifact", "mask"])
def test_what_a_photo_hides_others_fill_or_a_backdrop_continues(by: str) -> None:
    left = torch.where(torch.arange(WIDTH)[:, None] < 60, 0.05, 1.0).expand(HEIGHT, WIDTH, 1)
    photo = wall_view(pose())
    if by == "artifact":
        panel = (left, (1 - left) * torch.tensor([1.0, 0.0, 0.0]))
        half = View(photo.image * panel[0] + panel[1], None, photo.world_to_camera, K)
    else:
        panel, half = None, wall_view(pose(), mask=(left[..., 0] == 1).float())
    everything, nothing = filled(wall_points(), [photo])
    assert not len(nothing)
    shown, hidden = filled(wall_points(), [half], [panel])
    assert 0.3 < len(shown) / len(everything) < 0.6
    assert shown.positions[:, 0].min() > 0 > hidden.positions[:, 0].max()
    assert 0.85 < (len(shown) + len(hidden)) / len(everything) <= 1, "but for the border, where seeds are near"
    torch.testing.assert_close(shown.positions[:, 2], torch.full((len(shown),), AT), rtol=1e-3, atol=0)
    torch.testing.assert_close(shown.colors, color_of(*shown.positions[:, :2].unbind(dim=1)), atol=1e-3, rtol=0)
    torch.testing.assert_close((hidden.positions - FAR.center).norm(dim=1), torch.full((len(hidden),), FAR.radius))
    across = hidden.positions * (AT / hidden.positions[:, 2:])
    torch.testing.assert_close(hidden.colors, color_of(*across[:, :2].unbind(dim=1)), atol=0.15, rtol=0)
    shown, hidden = filled(wall_points(), [half, photo], [panel, None])
    assert len(shown) > 0.9 * len(everything)
    assert not len(hidden), "the other photo shows it"


def test_no_backdrop_is_where_a_film_still_shows_the_scene() -> None:
    """As in the corners behind a vignette: too dark for seeds, but splats learn what is there."""
    film = torch.full((HEIGHT, WIDTH, 1), 0.3), torch.zeros(HEIGHT, WIDTH, 3)
    photo = View(wall_view(pose()).image * film[0], None, pose(), K)
    assert not any(len(seeds) for seeds in filled(wall_points(), [photo], [film]))


def test_a_wrong_match_in_a_gap_reaches_no_farther_than_the_seeds_beside_it() -> None:
    stray = torch.tensor([[0.1, 0.0, 1.0]])
    views = [wall_view(pose()), wall_view(pose(right=0.7)), wall_view(pose(right=-0.7))]
    seeds = gaps(torch.cat([wall_points(), stray]), views)
    assert ((seeds.positions[:, 2] - AT).abs() < 0.01).float().mean() > 0.8


def test_large_photos_are_filled_as_small_ones() -> None:
    """Where a working pixel is four of a photo's."""
    y, x = torch.meshgrid(torch.arange(4 * HEIGHT) + 0.5, torch.arange(4 * WIDTH) + 0.5, indexing="ij")
    lens = torch.tensor([[4.0], [4.0], [1.0]]) * K
    large = [
        View(color_of((x - 240) / 400 * AT - matrix[0, 3], (y - 180) / 400 * AT), None, matrix, lens)
        for matrix in (pose(), pose(right=0.7))
    ]
    assert scene_photos(large, [None] * 2, [0] * 2)[0].reduction == 2
    seeds = gaps(wall_points(), large)
    assert len(seeds) > 2 * len(gaps(wall_points(), [wall_view(pose())])), "finer working pixels"
    torch.testing.assert_close(seeds.positions[:, 2], torch.full((len(seeds),), AT))
    torch.testing.assert_close(seeds.colors, color_of(*seeds.positions[:, :2].unbind(dim=1)), atol=1e-3, rtol=0)
    torch.testing.assert_close(seeds.widths, torch.full((len(seeds),), SPACING * 2 / 400 * AT))
    post = torch.cartesian_prod(torch.linspace(-0.22, -0.16, 8), torch.linspace(-1, 1, 80), torch.tensor([AT / 2]))
    points = torch.cat([wall_points(gap=0.5), post])
    alone, checked = (gaps(points, photos).positions[:, 2] for photos in (large[:1], large))
    assert (checked < 0.8 * AT).sum() < 0.7 * (alone < 0.8 * AT).sum()


def test_a_seed_that_hides_what_another_photo_sees_is_left_out() -> None:
    """Beside a post the neighbors are on it, in front of a wall whose points another photo sees there."""
    post = torch.cartesian_prod(torch.linspace(-0.22, -0.16, 8), torch.linspace(-1, 1, 80), torch.tensor([AT / 2]))
    points = torch.cat([wall_points(gap=0.5), post])
    alone, checked = (gaps(points, [wall_view(pose()), *others]) for others in ([], [wall_view(pose(right=-1.0))]))
    alone_near, checked_near = (int((seeds.positions[:, 2] < 0.8 * AT).sum()) for seeds in (alone, checked))
    assert alone_near > 5
    assert checked_near < 0.3 * alone_near
    assert len(checked) - checked_near >= len(alone) - alone_near, "those on the wall stay"


def test_a_sphere_is_left_from_anywhere_in_it() -> None:
    sphere = Sphere(torch.tensor([1.0, 2.0, 3.0]), 5.0)
    rays = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    for camera in (sphere.center, sphere.center + torch.tensor([2.0, 0.0, 1.0])):
        depths = sphere.depths(camera, rays)
        assert depths.min() > 0
        distances = (camera + depths[:, None] * rays - sphere.center).norm(dim=1)
        torch.testing.assert_close(distances, torch.full((50,), 5.0))
    assert sphere.depths(sphere.center + 100, rays).min() > 1, "outside it is before no camera"


def test_without_enough_points_there_is_no_depth() -> None:
    assert not len(gaps(wall_points()[: NEIGHBORS - 1], [wall_view(pose())]))
    away = torch.tensor([[0.0, 0.0, -AT]]).expand(50, 3)
    assert not len(gaps(away, [wall_view(pose())]))


def test_no_more_photos_are_read_than_the_most() -> None:
    views = [wall_view(pose(right=30.0 * number)) for number in range(3 * MAX_VIEWS)]
    points = torch.cat([wall_points()[::50] + torch.tensor([30.0 * number, 0, 0]) for number in range(3 * MAX_VIEWS)])
    places = (gaps(points, views).positions[:, 0] / 30).round().unique()
    assert MAX_VIEWS // 2 < len(places) <= MAX_VIEWS
    assert places.max() > 2.5 * MAX_VIEWS
