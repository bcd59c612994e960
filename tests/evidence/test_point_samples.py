"""Where the views see the scene's points, and which of them: pinhole cameras whose answer is known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ssa_nerfstudio.evidence import point_samples
from ssa_nerfstudio.evidence.point_samples import View, sample_points

K = torch.tensor([[40.0, 0.0, 30.0], [0.0, 40.0, 20.0], [0.0, 0.0, 1.0]])


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
    points = torch.tensor([[0.0, 0.0, 2.0], [0.5, -0.25, 2.0], [0.0, 0.0, -2.0], [9.0, 0.0, 2.0]])
    samples = sample_points(points, [view(coordinates(dtype)), view(coordinates(dtype), x=0.5)])
    assert samples.size == (40, 60)
    assert samples.points == 4
    found = sorted(zip(samples.point.tolist(), samples.pixel.tolist(), strict=True))
    # x = 40 X / Z + 30, y = 40 Y / Z + 20; the second camera is 0.5 to the right: 10 pixels.
    assert found == [(0, 20 * 60 + 20), (0, 20 * 60 + 30), (1, 15 * 60 + 30), (1, 15 * 60 + 40)]
    scale = 65535 / 256 if dtype == torch.uint16 else 255
    rows, columns = samples.pixel // 60, samples.pixel % 60
    torch.testing.assert_close(samples.color[:, 0] * scale, rows.float(), atol=0.01, rtol=0)
    torch.testing.assert_close(samples.color[:, 1] * scale, columns.float(), atol=0.01, rtol=0)
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


def test_large_photos_are_reduced_and_many_points_thinned(monkeypatch) -> None:
    image = torch.full((540, 960, 4), 51, dtype=torch.uint8)
    big = View(image, None, torch.eye(4), torch.tensor([[600.0, 0, 480], [0, 600, 270], [0, 0, 1]]))
    points = torch.rand(1000, 3) * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([-0.5, -0.5, 2.0])
    samples = sample_points(points, [big, big])
    assert samples.size == (135, 240)
    torch.testing.assert_close(samples.color, torch.full_like(samples.color, 0.2))
    monkeypatch.setattr(point_samples, "MAX_PROJECTIONS", 500)
    assert sample_points(points, [big, big]).points == 250


def test_no_point_in_sight_gives_no_sample() -> None:
    samples = sample_points(torch.tensor([[0.0, 0.0, -1.0]]), [view(coordinates())])
    assert samples.color.shape == (0, 3)
