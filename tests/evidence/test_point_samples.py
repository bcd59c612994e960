"""Where the views see the scene's points, and which of them: pinhole cameras whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence import point_samples
from ssa_nerfstudio.evidence.initialization import guide_of
from ssa_nerfstudio.evidence.point_samples import View, sample_points
from ssa_nerfstudio.evidence.statistics import UNKNOWN_DEVIATION, accumulate

UNKNOWN = torch.full((540, 960, 4), UNKNOWN_DEVIATION)
"""Of photos of which no two show a pixel: samples are left as they are read."""
LARGE_K = torch.tensor([[600.0, 0.0, 480.0], [0.0, 600.0, 270.0], [0.0, 0.0, 1.0]])
"""Of a frame of 960 x 540 pixels, four to a working pixel."""
K = torch.tensor([[40.0, 0.0, 30.0], [0.0, 40.0, 20.0], [0.0, 0.0, 1.0]])

NEEDS_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")


def view(image: Tensor, x: float = 0.0, mask: Tensor | None = None) -> View:
    """A camera at (x, 0, 0) that looks along z."""
    pose = torch.eye(4)
    pose[0, 3] = -x
    return View(image, mask, pose, K)


def coordinates(dtype: torch.dtype = torch.uint8) -> Tensor:
    """[40, 60, 3]: each pixel's row and column are its color."""
    image = torch.zeros(40, 60, 3, dtype=torch.int64)
    image[..., 0], image[..., 1] = torch.arange(40)[:, None], torch.arange(60)
    return (image * 256 if dtype == torch.uint16 else image).to(dtype) if dtype != torch.float32 else image / 255


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float32])
def test_a_sample_is_the_photo_where_the_point_projects(dtype: torch.dtype) -> None:
    points = torch.tensor([[0.0125, 0.04, 2.0], [0.5, -0.25, 2.0], [0.0, 0.0, -2.0], [9.0, 0.0, 2.0]])
    samples = sample_points(points, [view(coordinates(dtype)), view(coordinates(dtype), x=0.5)])
    assert samples.size == (40, 60)
    assert samples.points == 4
    # x = 40 X / Z + 30, y = 40 Y / Z + 20; the second camera is 0.5 to the right: 10 pixels.
    place = torch.tensor([[20.25, 20.8], [30.25, 20.8], [30.0, 15.0], [40.0, 15.0]])
    order = torch.argsort(samples.point * 10_000 + samples.pixel)
    assert samples.point[order].tolist() == [0, 0, 1, 1]
    assert samples.pixel[order].tolist() == [20 * 60 + 20, 20 * 60 + 30, 15 * 60 + 30, 15 * 60 + 40]
    scale = 65535 / 256 if dtype == torch.uint16 else 255
    # Pixels have their centers at one half.
    torch.testing.assert_close(samples.color[order, 0] * scale, place[:, 1] - 0.5, atol=0.01, rtol=0)
    torch.testing.assert_close(samples.color[order, 1] * scale, place[:, 0] - 0.5, atol=0.01, rtol=0)
    assert samples.point.tolist() == sorted(samples.point.tolist())


def test_a_point_behind_a_nearer_one_is_not_seen() -> None:
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.02, 0.0, 1.02], [0.5, 0.0, 2.0]])
    samples = sample_points(points, [view(coordinates())])
    assert samples.point.tolist() == [0, 2, 3], "the second is behind the first; the third belongs to its surface"


def test_masked_pixels_and_points_that_are_not_finite_are_left_out() -> None:
    points = torch.tensor([[0.0, 0.0, 2.0], [torch.nan, 0.0, 2.0], [0.5, 0.0, 2.0]])
    mask = torch.ones(40, 60, 1, dtype=torch.bool)
    mask[:, :35] = False
    samples = sample_points(points, [view(coordinates(), mask=mask)])
    assert samples.pixel.tolist() == [20 * 60 + 40]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_a_sample_shows_the_layers_of_its_pixel_on_either_side_of_an_edge(dtype: torch.dtype) -> None:
    """The artifact ends in the middle of the frame, between two working pixels; what is behind has one color a view."""
    clear, opaque = torch.tensor([1.0, 0.0]), torch.tensor([0.3, 0.5])
    layers = torch.where(torch.arange(960)[None, :, None] < 480, opaque, clear).expand(540, 960, 2)
    brightness = torch.linspace(0.2, 0.9, 7)
    images = [(layers[..., :1] * each + layers[..., 1:]).expand(-1, -1, 3) for each in brightness]
    images = [image if dtype == torch.float32 else (255 * image).round().to(dtype) for image in images]
    views = [View(image, None, torch.eye(4), LARGE_K) for image in images]
    points = torch.stack(torch.meshgrid(torch.linspace(-0.03, 0.03, 40), torch.tensor([0.0, 0.3]), indexing="ij"), -1)
    points = torch.cat([points.reshape(-1, 2), torch.full((80, 1), 2.0)], dim=-1)
    samples = sample_points(points, views, guide_of(accumulate((image, None) for image in images)))
    of_pixel = torch.where(samples.pixel[:, None] % 240 < 120, opaque, clear)
    expected = of_pixel[:, 0] * brightness[samples.view] + of_pixel[:, 1]
    assert {0.3, 1.0} == {round(float(each), 3) for each in of_pixel[:, 0]}
    torch.testing.assert_close(samples.color, expected[:, None].expand(-1, 3), atol=0.01, rtol=0)
    between = sample_points(points, views)
    assert ((between.color - expected[:, None]).abs() > 0.05).any(), "without the photos' mean and deviation"


def plane(distance: float) -> View:
    """A camera before a plane of bright dots, 0.02 wide and 0.1 apart, with as much light on average everywhere."""
    side, focal = 4, float(LARGE_K[0, 0])
    y, x = torch.meshgrid(*(torch.arange(side * n) / side + 0.5 / side for n in (540, 960)), indexing="ij")
    dots = [((each * distance / focal + 0.01) % 0.1 < 0.02).float() for each in (x - 480, y - 270)]
    photo = nn.functional.avg_pool2d((0.1 + 0.8 * dots[0] * dots[1])[None], side)[0, ..., None].expand(-1, -1, 3)
    pose = torch.eye(4)
    pose[2, 3] = distance
    return View(photo, None, pose, LARGE_K)


def test_a_patch_shows_the_same_of_the_scene_from_near_and_far() -> None:
    """A dot covers a working pixel from 2 units, and a sixth of one from 5."""
    points = torch.tensor([[0.1 * i, 0.1 * j, 0.0] for i in (-2, -1, 0, 1) for j in (-1, 0, 1)])
    samples = sample_points(points, [plane(2.0), plane(5.0)], UNKNOWN)
    near, far = ((samples.view == view).nonzero()[:, 0] for view in (0, 1))
    assert samples.point[near].tolist() == samples.point[far].tolist() == list(range(12))
    assert (samples.color[near] - samples.color[far]).min() > 0.3
    assert samples.patch is not None
    assert (samples.patch[near] - samples.patch[far]).abs().max() < 0.02


@pytest.mark.parametrize("at_once", [1, 2])
def test_many_views_are_sampled_as_each_by_itself(monkeypatch: pytest.MonkeyPatch, at_once: int) -> None:
    """Also where they are more than are projected at once, some have masks, and photos are of different types."""
    monkeypatch.setattr(point_samples, "VIEWS_AT_ONCE", 2)
    monkeypatch.setattr(point_samples, "photos_at_once", lambda *_: at_once)
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(300, 3, generator=generator) * torch.tensor([4.0, 4.0, 3.0]) + torch.tensor([-2.0, -2.0, 1.0])
    types = [torch.uint8, torch.float32, torch.uint16, torch.uint8, torch.float32]
    masks = [None, None, torch.arange(60).expand(40, 60) % 20 > 1, None, None]
    views = [
        view(coordinates(dtype), x=0.3 * number, mask=mask)
        for number, (dtype, mask) in enumerate(zip(types, masks, strict=True))
    ]
    guide = torch.full((40, 60, 4), 0.1)
    together = sample_points(points, views, guide)
    assert together.patch is not None
    for number, each in enumerate(views):
        alone, own = sample_points(points, [each], guide), together.view == number
        assert 50 < len(alone.point) < 150  # some are hidden, and some beside the frame
        assert together.point[own].tolist() == alone.point.tolist()
        assert together.pixel[own].tolist() == alone.pixel.tolist()
        torch.testing.assert_close(together.color[own], alone.color)
    monkeypatch.setattr(point_samples, "photos_at_once", lambda *_: 1)
    torch.testing.assert_close(together.patch, sample_points(points, views, guide).patch)


def test_patches_belong_to_the_points_that_a_mask_leaves() -> None:
    image = torch.where(torch.arange(60) < 30, 0.2, 0.8)[:, None].expand(40, 60, 3)
    mask = (torch.arange(60) >= 30).expand(40, 60)
    points = torch.tensor([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0], [0.5, 0.3, 2.0]])  # the mask hides the first
    samples = sample_points(points, [View(image, mask, torch.eye(4), K)], UNKNOWN[:40, :60])
    assert samples.point.tolist() == [1, 2]
    torch.testing.assert_close(samples.patch, torch.full((2, 3), 0.8))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=NEEDS_CUDA)])
def test_the_last_position_before_the_frames_edge_is_in_its_last_pixel(device: str) -> None:
    """640 x 480 pixels, three to a working pixel: on a GPU 479.99997 / 3 is 160, as it multiplies by 1 / 3."""
    last = torch.nextafter(torch.tensor([639.0, 480.0]), torch.zeros(2))  # 213 x 160 working pixels
    points = torch.cat([last, torch.ones(1)])[None].to(device)
    plain = View(torch.full((480, 640, 3), 0.5, device=device), None, torch.eye(4), torch.eye(3))
    samples = sample_points(points, [plain])
    assert samples.size == (160, 213)
    assert samples.pixel.tolist() == [160 * 213 - 1]


def test_samples_state_the_ratio_of_focal_lengths() -> None:
    plain = view(torch.rand(40, 90, 3))
    stretched = replace(plain, intrinsics=torch.diag(torch.tensor([1.5, 1.0, 1.0])) @ plain.intrinsics)
    points = torch.tensor([[0.0, 0.0, 2.0], [0.4, 0.0, 5.0], [-0.4, 0.0, 3.0]])
    assert sample_points(points, [stretched, stretched]).focal_ratio == pytest.approx(1.5)


@pytest.mark.parametrize("at_once", [1, 2])
def test_patches_are_means_over_squares_that_end_at_the_frame_and_at_masks(
    monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    """Of noise, around points in the frame's corners and beside a mask, under a gain for each channel."""
    monkeypatch.setattr(point_samples, "photos_at_once", lambda *_: at_once)
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (2, 40, 60, 3), generator=generator, dtype=torch.uint8)
    mask = torch.rand(40, 60, generator=generator) > 0.2
    gain = torch.tensor([0.5, 1.0, 2.0])
    place = torch.tensor([[0, 0], [59, 0], [0, 39], [59, 39], [30, 20], [20, 38], [57, 21]])
    depth = torch.tensor([2.1, 3.0, 2.5, 2.1, 4.0, 2.1, 3.0])
    points = torch.cat([(place + 0.5 - torch.tensor([30.0, 20.0])) / 40, torch.ones(7, 1)], dim=-1) * depth[:, None]
    mask[place[:, 1], place[:, 0]] = True
    back = torch.eye(4)
    back[2, 3] = 3.0  # the points are farther from there
    for seen in (None, mask):
        views = [View(images[0], seen, torch.eye(4), K, gain), View(images[1], None, back, K)]
        samples = sample_points(points, views, UNKNOWN[:40, :60])
        assert samples.patch is not None
        near = samples.view == 0
        assert samples.point[near].tolist() == samples.point[~near].tolist() == list(range(7))
        assert samples.pixel[near].tolist() == (place[:, 0] + 60 * place[:, 1]).tolist()
        for at, number in enumerate(samples.view.tolist()):
            row, column = divmod(int(samples.pixel[at]), 60)
            own = float(depth[samples.point[at]])
            side = 5 if number else round(5 * (own + 3) / own)
            left, top = (round(each + 0.5 - side / 2) for each in (column, row))
            part = slice(max(top, 0), top + side), slice(max(left, 0), left + side)
            counts = (torch.ones(40, 60, dtype=torch.bool) if number or seen is None else seen)[part]
            expected = images[number][part][counts].float().mean(dim=0) / 255
            assert side % 2 == 0 or (side - 1) / 2 == column - left  # odd ones are around the pixel
            torch.testing.assert_close(samples.patch[at], expected if number else expected / gain)


def test_patches_leave_out_what_is_opaque() -> None:
    """A bar covers the left half: beside it a patch is of the scene alone, and in the middle of it of nothing."""
    image = torch.rand(40, 60, 3, generator=torch.Generator().manual_seed(0))
    opaque = torch.zeros(40, 60, dtype=torch.bool)
    opaque[:, :30] = True
    place = torch.tensor([[31, 20], [50, 20], [8, 20]])
    points = torch.cat([(place + 0.5 - torch.tensor([30.0, 20.0])) / 40, torch.ones(3, 1)], dim=-1) * 2
    mask = torch.ones(40, 60)
    mask[18] = 0
    for seen_by in (None, mask):
        views = [View(image, seen_by, torch.eye(4), K)] * 2
        plain, beside = (sample_points(points, views, UNKNOWN[:40, :60], bar) for bar in (None, opaque))
        torch.testing.assert_close(beside.color, plain.color, rtol=0, atol=0)
        assert beside.patch is not None
        assert plain.patch is not None
        rows = slice(18 if seen_by is None else 19, 23)
        first, second, third = (beside.patch[beside.point == number] for number in range(3))
        torch.testing.assert_close(first, image[rows, 30:34].mean(dim=(0, 1)).expand(2, 3))
        torch.testing.assert_close(second, plain.patch[plain.point == 1])
        assert third.isnan().all()
        assert not plain.patch.isnan().any()


def test_patches_leave_out_working_pixels_that_hold_anything_opaque() -> None:
    """Two pixels to a working pixel, of which a bar cuts one; in the middle of it rounding leaves no patch."""
    image = torch.rand(320, 480, 3, generator=torch.Generator().manual_seed(0))
    opaque = torch.zeros(320, 480, dtype=torch.bool)
    opaque[:, 101:300] = True
    lens = torch.tensor([[300.0, 0.0, 240.0], [0.0, 300.0, 160.0], [0.0, 0.0, 1.0]])
    place = torch.tensor([[97.0, 161.0], [201.0, 161.0]])
    points = torch.cat([(place - torch.tensor([240.0, 160.0])) / 300, torch.ones(2, 1)], dim=-1) * 2
    samples = sample_points(points, [View(image, None, torch.eye(4), lens)] * 2, UNKNOWN[:320, :480], opaque)
    assert samples.patch is not None
    assert samples.size == (160, 240)
    beside, inside = (samples.patch[samples.point == number] for number in range(2))
    # Five working pixels around 48: 46 to 49, because the bar begins in 50.
    torch.testing.assert_close(beside, image[156:166, 92:100].mean(dim=(0, 1)).expand(2, 3))
    assert inside.isnan().all()


def test_what_a_mask_hides_is_never_read() -> None:
    """Not even where it is no number."""
    image, mask = torch.full((540, 960, 3), 0.75), torch.ones(540, 960, dtype=torch.bool)
    mask[:, :476] = False
    image[~mask] = torch.nan
    points = torch.tensor([[0.002, 0.0, 0.6], [0.1, 0.1, 0.6]])
    samples = sample_points(points, [View(image, mask, torch.eye(4), LARGE_K)], UNKNOWN)
    torch.testing.assert_close(samples.patch, torch.full((2, 3), 0.75))
    torch.testing.assert_close(samples.color, torch.full((2, 3), 0.75))


def test_colors_are_brought_to_one_exposure_and_bounded_by_white() -> None:
    points = torch.tensor([[0.5, -0.25, 2.0]])
    gain = torch.tensor([0.5, 1.0, 2.0])
    image = torch.full((40, 60, 3), 0.6)
    samples = sample_points(points, [View(image, None, torch.eye(4), K, gain)])
    torch.testing.assert_close(samples.color, torch.tensor([[1.2, 0.6, 0.3]]))
    assert samples.patch is None
    # What is behind an opaque edge hardly varies: one photo that shows something else there is an outlier.
    still = torch.where(torch.arange(60) < 40, 0.02, 0.5)[:, None].expand(40, 60, 3)
    guide = torch.cat([still, torch.where(torch.arange(60) < 40, 0.001, 0.25).expand(40, 60)[..., None]], dim=-1)
    points = torch.tensor([[0.5, -0.25, 1.9999], [0.5 + 0.01, -0.25, 2.0]])  # on either side of column 40
    for value, white in ((1.0, True), (0.0, False)):
        samples = sample_points(points, [View(torch.full((40, 60, 3), value), None, torch.eye(4), K, gain)], guide)
        bound = 1 / gain if white else torch.zeros(3)
        assert (samples.color == bound).all(dim=-1).any()
        assert (samples.color <= 1 / gain).all()
        assert (samples.color >= 0).all()


def test_where_too_few_photos_show_a_pixel_samples_stay_as_they_are_read() -> None:
    """The left half of the frame is masked in all photos but one."""
    left = torch.ones(540, 960, dtype=torch.bool)
    left[:, :480] = False
    images, masks = [torch.full((540, 960, 3), value) for value in (0.3, 0.5, 0.7)], [None, left, left]
    points = torch.stack([torch.linspace(-0.02, 0.02, 60), torch.linspace(-0.4, 0.4, 60), torch.ones(60)], dim=1)
    views = [View(image, mask, torch.eye(4), LARGE_K) for image, mask in zip(images, masks, strict=True)]
    samples = sample_points(points, views, guide_of(accumulate(zip(images, masks, strict=True))))
    expected = torch.tensor([0.3, 0.5, 0.7])[samples.view, None].expand(-1, 3)
    torch.testing.assert_close(samples.color, expected)


def test_points_of_any_type_at_absurd_depths_are_sampled() -> None:
    points = torch.tensor([[0.0, 0.0, 2e-6], [0.5, -0.25, 2.0]], dtype=torch.float64)
    far = torch.eye(4, dtype=torch.float64)
    far[2, 3] = 1e20
    views = [View(coordinates(), None, pose, K) for pose in (torch.eye(4), far)]
    samples = sample_points(points, views, UNKNOWN[:40, :60])
    assert samples.patch is not None
    assert torch.isfinite(samples.patch).all()
    assert torch.isfinite(samples.color).all()


def test_a_box_that_a_mask_touches_is_left_out() -> None:
    mask = torch.ones(540, 960, dtype=torch.bool)
    mask[:, :478] = False  # the working pixel from 480 to 483 is seen
    points = torch.tensor([[-0.001, 0.0, 0.6], [0.0015, 0.0, 0.6], [0.0005, 0.1, 0.6]])  # at 479, 481.5 and 480.5
    samples = sample_points(points, [View(torch.zeros(540, 960, 3), mask, torch.eye(4), LARGE_K)])
    assert samples.point.tolist() == [1, 2]
    mask[:, :480] = False
    samples = sample_points(points, [View(torch.zeros(540, 960, 3), mask, torch.eye(4), LARGE_K)])
    assert samples.point.tolist() == [], "the box around 481.5 begins at 479.5"
    mask[:, :481] = False
    beside = torch.tensor([[0.0034, 0.0, 0.6], [0.0054, 0.0, 0.6]])  # at 483.4 and 485.4
    samples = sample_points(beside, [View(torch.zeros(540, 960, 3), mask, torch.eye(4), LARGE_K)])
    assert samples.point.tolist() == [1], "the first is in a working pixel that begins at 480"


def test_rounding_of_what_hardly_varies_is_not_enlarged() -> None:
    """A panel before all photos: its deviations of a tenth and a hundredth of a gray level say nothing."""
    level = 1 / 255
    image = torch.full((40, 60, 3), 0.5 + level)
    deviation = torch.where(torch.arange(60) < 40, 0.01 * level, 0.1 * level).expand(40, 60)[..., None]
    guide = torch.cat([torch.full((40, 60, 3), 0.5), deviation], dim=-1)
    points = torch.tensor([[0.5 + 0.01, -0.25, 2.0]])  # its box is in both parts
    samples = sample_points(points, [View(image, None, torch.eye(4), K)], guide)
    assert (samples.color - image[0, 0]).abs().max() < 0.2 * level


def test_large_photos_are_reduced_and_many_points_thinned(monkeypatch) -> None:
    image = torch.full((540, 960, 4), 51, dtype=torch.uint8)
    big = View(image, None, torch.eye(4), LARGE_K)
    points = torch.rand(1000, 3) * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([-0.5, -0.5, 2.0])
    samples = sample_points(points, [big, big])
    assert samples.size == (135, 240)
    torch.testing.assert_close(samples.color, torch.full_like(samples.color, 0.2))
    monkeypatch.setattr(point_samples, "MAX_PROJECTIONS", 500)
    assert sample_points(points, [big, big]).points == 250


def test_no_point_in_sight_gives_no_sample() -> None:
    samples = sample_points(torch.tensor([[0.0, 0.0, -1.0]]), [view(coordinates())])
    assert samples.color.shape == (0, 3)
