"""What is far away where no point is: cameras that turn before a sky, a ground of points, and artifacts."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from ssa_nerfstudio.evidence import distant_points as distant_points_module
from ssa_nerfstudio.evidence.distant_points import (
    SIGNIFICANCE,
    _directions,
    _distant,
    _significance,
    distant_points,
    horizon,
)
from ssa_nerfstudio.evidence.point_samples import View
from ssa_nerfstudio.evidence.scene_photos import scene_photos
from ssa_nerfstudio.evidence.seeds import Seeds

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


def turning_views(artifact: tuple[Tensor, Tensor] | None = None, still: bool = False, step: float = 0.1) -> list[View]:
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
        pose[:3, :3], pose[2, 3] = turn, -step * number
        photo = sky(rays if still else rays @ turn)
        if artifact is not None:
            photo = artifact[0] * photo + artifact[1]
        views.append(View(photo, None, pose, K))
    return views


def distant(points: Tensor, *photos: Any) -> Seeds:
    """`distant_points` of photos, of which views, layers and groups are given."""
    of_scene = scene_photos(*photos)
    return distant_points(points, of_scene, horizon(points, of_scene))


def errors(found: Seeds) -> Tensor:
    """[N]: of the points' colors against the sky's, seen from the cameras' mean."""
    center = torch.stack([-(v.world_to_camera[:3, :3].T @ v.world_to_camera[:3, 3]) for v in turning_views()]).mean(0)
    return (found.colors - sky(found.positions - center)).abs().amax(dim=-1)


def test_a_sky_is_found_where_no_point_is_and_has_its_colors() -> None:
    found = distant(GROUND, turning_views(), SIGHT, ONE)
    assert len(found.positions) > 200
    down = found.positions[:, 1] / found.positions.norm(dim=-1)
    assert down.max() < 0.1, "below the horizon the ground has points of its own"
    assert errors(found).mean() < 0.03
    distances = found.positions.norm(dim=-1)
    assert distances.min() > 2 * GROUND.norm(dim=-1).max()
    nearest = torch.cdist(found.positions, found.positions).fill_diagonal_(math.inf).amin(dim=1)
    assert nearest.median() == pytest.approx(found.widths[0].item(), rel=0.2)


def test_a_picture_that_stands_still_in_the_frame_is_not_far_away() -> None:
    sky_seeds = len(distant(GROUND, turning_views(), SIGHT, ONE))
    assert len(distant(GROUND, turning_views(still=True), SIGHT, ONE)) < 0.1 * sky_seeds


def test_colors_are_those_behind_a_film() -> None:
    T, B = torch.full((HEIGHT, WIDTH, 1), 0.7), torch.full((HEIGHT, WIDTH, 3), 0.2)
    found = distant(GROUND, turning_views((T, B)), [(T, B)] * 7, ONE)
    assert len(found.positions) > 200
    assert errors(found).mean() < 0.03


def test_a_sky_is_not_what_an_opaque_panel_shows() -> None:
    hiding = torch.where(torch.arange(WIDTH)[:, None] < 30, 0.02, 1.0).expand(HEIGHT, WIDTH, 1)
    panel = (hiding, (1 - hiding) * torch.tensor([0.9, 0.1, 0.1]))
    found = distant(GROUND, turning_views(panel), [panel] * 7, ONE)
    assert 0.5 < len(found) / len(distant(GROUND, turning_views(), SIGHT, ONE)) < 0.85
    assert errors(found).mean() < 0.03
    assert not ((found.colors[:, 0] > 0.88) & (found.colors[:, 1] < 0.15)).any(), "the panel's"


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
    assert not len(distant(points, views, SIGHT, ONE))


def test_masked_pixels_and_gains_count() -> None:
    plain = distant(GROUND, turning_views(), SIGHT, ONE)
    gain = torch.tensor([0.5, 0.8, 1.0])
    views = [View((v.image * gain * 65535).to(torch.int32).to(torch.uint16), None, v.world_to_camera, K, gain)
             for v in turning_views()]  # fmt: skip
    assert torch.allclose(distant(GROUND, views, SIGHT, ONE).colors, plain.colors, atol=1e-3)
    nothing = [View(v.image, torch.zeros(HEIGHT, WIDTH), v.world_to_camera, K) for v in views]
    assert not len(distant(GROUND, nothing, SIGHT, ONE))


def test_two_views_are_too_few() -> None:
    assert not len(distant(GROUND, turning_views()[:2], SIGHT[:2], ONE[:2]))


def test_views_of_several_sizes_are_each_compared_with_their_own() -> None:
    views = turning_views()
    small = torch.tensor([[0.5], [0.5], [1.0]]) * K
    halves = [
        View(v.image.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(dim=(1, 3)), None, v.world_to_camera, small)
        for v in views[1::2]
    ]
    found = distant(GROUND, [*views[::2], *halves], SIGHT, ONE)
    assert len(found.positions) > 100
    assert errors(found).mean() < 0.05


def test_cameras_with_a_still_picture_each_have_no_sky_together() -> None:
    """The mean over both would explain neither."""
    views = turning_views(still=True)
    other = [View(v.image.flip(1), None, v.world_to_camera, K) for v in views]
    found = distant(GROUND, [*views, *other], [None] * 14, [0] * 7 + [1] * 7)
    assert len(found) < 0.1 * len(distant(GROUND, turning_views(), SIGHT, ONE))


@pytest.mark.parametrize("exposed", [True, False])
def test_a_gain_acts_on_the_artifact_or_on_the_scene_alone(exposed: bool) -> None:
    T, B = torch.full((HEIGHT, WIDTH, 1), 0.7), torch.full((HEIGHT, WIDTH, 3), 0.2)
    gain = torch.tensor([0.6, 0.7, 0.9])
    views = []
    for v in turning_views():
        photo = gain * (T * v.image + B) if exposed else T * gain * v.image + B
        views.append(View(photo, None, v.world_to_camera, K, gain))
    found = distant(GROUND, views, [(T, B)] * 7, ONE, exposed)
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
    assert len(distant(torch.cat([GROUND, hills]), views, SIGHT, ONE)) > 200


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
    found = distant(GROUND, views, SIGHT, ONE)
    assert len(found) > 0.98 * len(distant(GROUND, turning_views(), SIGHT, ONE))
    assert errors(found).median() < 0.03


def noisy(view: View, generator: torch.Generator, amount: float = 0.01) -> View:
    """A view with noise of its sensor."""
    image = view.image + amount * torch.randn(view.image.shape, generator=generator)
    return View(image.clamp(0, 1), None, view.world_to_camera, K)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.01, 1.0])
def test_noise_alone_is_not_far_away(noise: float, seed: int) -> None:
    """A plain wall, and photos of which no two agree: every distance explains them as well, in however many frames."""
    generator = torch.Generator().manual_seed(seed)
    plain = [View(torch.full_like(v.image, 0.6), None, v.world_to_camera, K) for v in turning_views(step=0.5)]
    views = [noisy(view, generator, noise) for view in plain]
    assert not len(distant(GROUND, views, SIGHT, ONE))


def test_a_smooth_sky_is_found_below_noise() -> None:
    """Between neighboring directions its color changes by less than the noise."""
    generator = torch.Generator().manual_seed(0)
    views = []
    for view in turning_views():
        smooth = View(0.5 + 0.1 * (view.image - 0.5), None, view.world_to_camera, K)
        views.append(noisy(smooth, generator))
    found = distant(GROUND, views, SIGHT, ONE)
    assert len(found) > 200
    assert (found.positions[:, 1] / found.positions.norm(dim=-1)).max() < 0.1


def test_small_groups_find_what_one_group_does() -> None:
    """Three cameras of seven views each, and of one view each, which cannot stand still."""
    views = [view for view in turning_views() for _ in range(3)]
    one = len(distant(GROUND, views, [None] * 21, [0] * 21))
    assert one > 200
    for groups in ([0, 1, 2] * 7, list(range(21))):
        assert len(distant(GROUND, views, [None] * 21, groups)) > 0.9 * one


def area(center: tuple[float, float], angle: float, width: float) -> Tensor:
    """Directions [N, 3] of a lattice with this spacing, within a width around one (radians to the right and down)."""
    directions = _directions(round(4 * math.pi / angle**2)).float()
    at = torch.atan2(directions[:, 0], directions[:, 2]), torch.asin(directions[:, 1])
    return directions[((at[0] - center[0]).abs() < width) & ((at[1] - center[1]).abs() < width)]


def test_what_is_nearer_in_a_distant_area_is_left_out() -> None:
    """A sky, and a wall connected with it; elsewhere another wall, and a picture that stands still."""
    angle, generator = 0.03, torch.Generator().manual_seed(0)
    places = [(0.0, 0.0), (0.4, 0.0), (1.5, 0.0), (-1.5, 0.0)]
    parts = [area(place, angle, 0.2) for place in places]
    part = torch.cat([torch.full((len(each),), number) for number, each in enumerate(parts)])

    def differences(means: list[float]) -> Tensor:
        return torch.tensor(means)[part][:, None] + 0.1 * torch.randn(len(part), 9, generator=generator)

    far_from_still = differences([-0.3, -0.3, -0.3, 0.3])
    far_from_near = differences([-0.3, 0.3, 0.3, -0.3])
    other = differences([-0.3, -0.01, -0.01, -0.3])
    other[:, ::2] = math.nan
    found = _distant(torch.cat(parts), angle, far_from_still, [far_from_near, other])
    sky_share, wall_share = (float(found[part == number].float().mean()) for number in range(2))
    assert sky_share > 0.8
    assert wall_share < 0.25, "a patch lies on both"
    assert not found[part > 1].any()
    other[part == 0, 2:] = math.nan
    assert not _distant(torch.cat(parts), angle, far_from_still, [far_from_near, other]).any(), "one view says nothing"
    assert _distant(torch.cat(parts), angle, far_from_still, [])[part < 3].all(), "nothing speaks against it"
    assert not len(_distant(torch.zeros(0, 3), angle, torch.zeros(0, 9), []))


@pytest.mark.parametrize("views", [3, 4, 10, 60])
def test_chance_is_as_significant_as_stated(views: int) -> None:
    """Also where views have different numbers of differences."""
    generator = torch.Generator().manual_seed(views)
    parts, each = 20_000, 4
    values = torch.randn(parts * each, views, generator=generator).double()
    values[torch.rand(values.shape, generator=generator) < 0.2] = math.nan
    values[::each] = torch.randn(parts, views, generator=generator).double()
    part = torch.arange(parts).repeat_interleave(each)
    value = _significance(part, values, parts)
    for chance in ((value > 1).double().mean(), (value < -1).double().mean()):
        assert 0.4 * SIGNIFICANCE < chance < 2.5 * SIGNIFICANCE
    assert (_significance(part, values + 3, parts) > 1).double().mean() > (0.1 if views < 4 else 0.5)


def test_a_long_lens_has_fewer_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its pixels are smaller, and its directions are farther apart than two of them."""
    found = len(distant(GROUND, turning_views(), SIGHT, ONE))
    monkeypatch.setattr(distant_points_module, "MAX_DIRECTIONS", 4000)
    assert 20 < len(distant(GROUND, turning_views(), SIGHT, ONE)) < 0.5 * found
