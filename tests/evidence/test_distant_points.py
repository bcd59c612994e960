"""What is far away where no point is: cameras that turn before a sky, a ground of points, and artifacts."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from ssa_nerfstudio.evidence import distant_points as distant_points_module
from ssa_nerfstudio.evidence.distant_points import (
    MIN_DIRECTIONS,
    DistantPoints,
    _distant,
    _Explanation,
    distant_points,
)
from ssa_nerfstudio.evidence.point_samples import View

HEIGHT, WIDTH = 60, 80
K = torch.tensor([[70.0, 0.0, 40.0], [0.0, 70.0, 30.0], [0.0, 0.0, 1.0]])
SIGHT = [None] * 7
"""Layers of seven views without an artifact."""
ONE = [0] * 7
"""Groups of seven views of one camera."""
GROUND = torch.cartesian_prod(torch.linspace(-9, 9, 300), torch.tensor([1.0]), torch.linspace(1, 20, 500))
"""A plane below the cameras (y is down), dense in the frame's lower half."""


def sky(direction: Tensor) -> Tensor:
    """Color [..., 3] in [0, 1] that changes by a tenth over 4 degrees or so."""
    turn = torch.atan2(direction[..., 0], direction[..., 2])
    return torch.stack([0.5 + 0.4 * (12 * turn).sin(), 0.5 + 0.3 * (9 * turn).cos(), 0.4 + 0 * turn], dim=-1)


def turning_views(artifact: tuple[Tensor, Tensor] | None = None, still: bool = False) -> list[View]:
    """Seven cameras that go forward and turn by 12 degrees; a still picture stands in the frame instead of the sky."""
    x, y = torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5
    rays = torch.stack([*torch.meshgrid(y, x, indexing="ij"), torch.ones(HEIGHT, WIDTH)], dim=-1)[..., [1, 0, 2]]
    rays = rays @ torch.linalg.inv(K).T
    views = []
    for number in range(7):
        angle = math.radians(2 * number - 6)
        turn = torch.tensor(
            [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]],
            dtype=torch.float32,
        )
        pose = torch.eye(4)
        pose[:3, :3], pose[2, 3] = turn, -0.1 * number
        photo = sky(rays if still else rays @ turn)
        if artifact is not None:
            photo = artifact[0] * photo + artifact[1]
        views.append(View(photo, None, pose, K))
    return views


def errors(found: DistantPoints) -> Tensor:
    """[N]: of the points' colors against the sky's, seen from the cameras' mean."""
    center = torch.stack([-(v.world_to_camera[:3, :3].T @ v.world_to_camera[:3, 3]) for v in turning_views()]).mean(0)
    return (found.colors - sky(found.positions - center)).abs().amax(dim=-1)


def test_a_sky_is_found_where_no_point_is_and_has_its_colors() -> None:
    found, _ = distant_points(GROUND, turning_views(), SIGHT, ONE)
    assert len(found.positions) > 200
    down = found.positions[:, 1] / found.positions.norm(dim=-1)
    assert down.max() < 0.1, "below the horizon the ground has points of its own"
    assert errors(found).mean() < 0.03
    distances = found.positions.norm(dim=-1)
    assert distances.min() > 2 * GROUND.norm(dim=-1).max()
    nearest = torch.cdist(found.positions, found.positions).fill_diagonal_(math.inf).amin(dim=1)
    assert nearest.median() == pytest.approx(found.spacing, rel=0.2)


def test_a_picture_that_stands_still_in_the_frame_is_not_far_away() -> None:
    sky_seeds = len(distant_points(GROUND, turning_views(), SIGHT, ONE)[0])
    assert len(distant_points(GROUND, turning_views(still=True), SIGHT, ONE)[0]) < 0.1 * sky_seeds


def test_colors_are_those_behind_a_film() -> None:
    T, B = torch.full((HEIGHT, WIDTH, 1), 0.7), torch.full((HEIGHT, WIDTH, 3), 0.2)
    found, _ = distant_points(GROUND, turning_views((T, B)), [(T, B)] * 7, ONE)
    assert len(found.positions) > 200
    assert errors(found).mean() < 0.03


def test_the_sky_goes_on_behind_a_panel_without_its_color() -> None:
    hiding = torch.where(torch.arange(WIDTH)[:, None] < 30, 0.02, 1.0).expand(HEIGHT, WIDTH, 1)
    panel = (hiding, (1 - hiding) * torch.tensor([0.9, 0.1, 0.1]))
    found, hidden = distant_points(GROUND, turning_views(panel), [panel] * 7, ONE)
    without, nothing = distant_points(GROUND, turning_views(), SIGHT, ONE)
    assert not len(nothing)
    assert len(hidden) > 0.15 * len(without)
    assert len(found) + len(hidden) == pytest.approx(len(without), rel=0.1)
    assert errors(found).mean() < 0.03
    for colors in (found.colors, hidden.colors):
        assert not ((colors[:, 0] > 0.88) & (colors[:, 1] < 0.15)).any(), "the panel's"


def test_a_wall_without_points_is_not_far_away() -> None:
    """It has parallax: cameras that move sideways see the same of it elsewhere."""
    wall_at, views = 5.0, []
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    for number in range(7):
        pose = torch.eye(4)
        pose[0, 3] = 0.3 - 0.1 * number
        across = (x - 40) / 70 * wall_at - pose[0, 3]
        views.append(View(sky(torch.stack([across / 5, y * 0, y * 0 + 1], dim=-1)), None, pose, K))
    # Its points are at the sides, and no wider than the wall is far.
    points = torch.tensor([[side * (3.0 + 0.1 * i), 0.0, wall_at] for i in range(30) for side in (-1, 1)])
    assert not len(distant_points(points, views, SIGHT, ONE)[0])


def test_masked_pixels_and_gains_count() -> None:
    plain, _ = distant_points(GROUND, turning_views(), SIGHT, ONE)
    gain = torch.tensor([0.5, 0.8, 1.0])
    views = [View((v.image * gain * 65535).to(torch.int32).to(torch.uint16), None, v.world_to_camera, K, gain)
             for v in turning_views()]  # fmt: skip
    assert torch.allclose(distant_points(GROUND, views, SIGHT, ONE)[0].colors, plain.colors, atol=1e-3)
    nothing = [View(v.image, torch.zeros(HEIGHT, WIDTH), v.world_to_camera, K) for v in views]
    assert not any(map(len, distant_points(GROUND, nothing, SIGHT, ONE)))


def test_two_views_are_too_few() -> None:
    assert not any(map(len, distant_points(GROUND, turning_views()[:2], SIGHT[:2], ONE[:2])))


def test_views_of_several_sizes_are_each_compared_with_their_own() -> None:
    views = turning_views()
    small = torch.tensor([[0.5], [0.5], [1.0]]) * K
    halves = [
        View(v.image.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(dim=(1, 3)), None, v.world_to_camera, small)
        for v in views[1::2]
    ]
    found, _ = distant_points(GROUND, [*views[::2], *halves], SIGHT, ONE)
    assert len(found.positions) > 100
    assert errors(found).mean() < 0.05


def test_cameras_with_a_still_picture_each_have_no_sky_together() -> None:
    """The mean over both would explain neither."""
    views = turning_views(still=True)
    other = [View(v.image.flip(1), None, v.world_to_camera, K) for v in views]
    found, _ = distant_points(GROUND, [*views, *other], [None] * 14, [0] * 7 + [1] * 7)
    assert len(found) < 0.1 * len(distant_points(GROUND, turning_views(), SIGHT, ONE)[0])


@pytest.mark.parametrize("exposed", [True, False])
def test_a_gain_acts_on_the_artifact_or_on_the_scene_alone(exposed: bool) -> None:
    T, B = torch.full((HEIGHT, WIDTH, 1), 0.7), torch.full((HEIGHT, WIDTH, 3), 0.2)
    gain = torch.tensor([0.6, 0.7, 0.9])
    views = []
    for v in turning_views():
        photo = gain * (T * v.image + B) if exposed else T * gain * v.image + B
        views.append(View(photo, None, v.world_to_camera, K, gain))
    found, _ = distant_points(GROUND, views, [(T, B)] * 7, ONE, exposed)
    assert len(found) > 200
    assert errors(found).mean() < 0.03


def test_far_hills_do_not_hide_a_sky() -> None:
    """Where the scene's farthest points have no parallax, noise would decide between them and the sky."""
    generator = torch.Generator().manual_seed(0)
    views = [
        View((v.image + 0.02 * torch.randn(v.image.shape, generator=generator)).clamp(0, 1), None, v.world_to_camera, K)
        for v in turning_views()
    ]
    hills = torch.tensor([[0.0, 5.0, 300.0]]).expand(len(GROUND) // 49, 3)
    assert len(distant_points(torch.cat([GROUND, hills]), views, SIGHT, ONE)[0]) > 200


def test_leaves_that_hide_a_sky_from_some_views_leave_none_of_it_out() -> None:
    """At 6 units from the cameras, without points; some 30 % of the sky are behind them in each view."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ torch.linalg.inv(K).T
    views, hidden = [], []
    for view in turning_views():
        turn = view.world_to_camera[:3, :3]
        camera, direction = -(turn.T @ view.world_to_camera[:3, 3]), rays @ turn
        across, up, _ = (camera + direction * ((6 - camera[2]) / direction[..., 2:])).unbind(dim=-1)
        chance = ((127.1 * (10 * across).floor() + 311.7 * (10 * up).floor()).sin() * 43758.5) % 1
        leaf = (chance < 0.3) & (up < 0)
        hidden.append(leaf.float().mean())
        photo = torch.where(leaf[..., None], torch.tensor([0.1, 0.2, 0.05]), view.image)
        views.append(View(photo, None, view.world_to_camera, K))
    assert 0.1 < torch.stack(hidden).mean() < 0.2, "the sky is half of the frame"
    found, _ = distant_points(GROUND, views, SIGHT, ONE)
    assert len(found) > 0.98 * len(distant_points(GROUND, turning_views(), SIGHT, ONE)[0])
    assert errors(found).median() < 0.03


@pytest.mark.parametrize(("side", "found"), [(24, True), (16, False)])
def test_a_gap_between_points_is_no_sky_unless_it_is_wide(side: int, found: bool) -> None:
    """Splats grow into a small one from beside it."""
    across, up = torch.meshgrid(torch.arange(-90, 90) / 140, torch.arange(-60, 4) / 140, indexing="ij")
    hole = (across.abs() < side / 140) & ((up + 0.2).abs() < side / 140)
    leaves = 20 * torch.stack([across, up, torch.ones_like(up)], dim=-1)[~hole]
    seeds, _ = distant_points(torch.cat([GROUND[::5], leaves]), turning_views(), SIGHT, ONE)
    assert (len(seeds) >= MIN_DIRECTIONS) == found
    assert found or not len(seeds)


def explanation(residual: Tensor, sights: Tensor | int = 9) -> _Explanation:
    """Of directions with these residuals [N], seen by so many views."""
    seen = torch.as_tensor(sights).expand(len(residual))
    return _Explanation(torch.zeros(len(residual), 3), residual, residual, seen, seen, seen)


def test_an_area_is_compared_where_enough_views_see_all_alternatives() -> None:
    """Four areas of 40 directions: far away, nearer by, and two of which too few can be compared with the second."""
    area = torch.arange(4).repeat_interleave(40)
    far = torch.tensor([0.1, 0.3, 0.1, 0.1])[area]
    first = explanation(torch.full((160,), 0.2))
    sights = torch.full((160,), 9)
    sights[80 + MIN_DIRECTIONS - 1 : 120] = 2
    sights[120:] = 0
    # Where few views see it, a nearer distance explains them by chance.
    second = explanation(torch.where(sights < 3, 0.0, 0.2), sights)
    assert _distant(area, far, [first, second]).reshape(4, 40).all(dim=1).tolist() == [True, False, False, False]
    assert _distant(area, far, [first]).reshape(4, 40).all(dim=1).tolist() == [True, False, True, True]
    assert _distant(area, far, []).all(), "nothing speaks against it"
    sights[80 : 80 + MIN_DIRECTIONS] = 9
    second = explanation(torch.where(sights < 3, 0.0, 0.2), sights)
    assert _distant(area, far, [first, second])[80:120].all(), "directions that cannot be compared say nothing"


def test_few_directions_of_a_long_lens_are_too_few_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its directions are farther apart than two pixels, and as few of them are far away by chance."""
    found = len(distant_points(GROUND, turning_views(), SIGHT, ONE)[0])
    monkeypatch.setattr(distant_points_module, "MAX_DIRECTIONS", 4000)
    wider = len(distant_points(GROUND, turning_views(), SIGHT, ONE)[0])
    assert MIN_DIRECTIONS < wider < 0.5 * found
    monkeypatch.setattr(distant_points_module, "MAX_DIRECTIONS", 800)
    assert not len(distant_points(GROUND, turning_views(), SIGHT, ONE)[0])
