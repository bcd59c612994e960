"""Areas that a Gaussian covers in a frame: along rays, and as it is drawn."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
import torch
from beside_the_frame import areas, beside

from ssa_nerfstudio.rasterization import rasterizer
from ssa_nerfstudio.rasterization.interface import Gaussians

WIDTH, HEIGHT = 160, 240
K = torch.tensor([[170.0, 0.0, 80.0], [0.0, 170.0, 120.0], [0.0, 0.0, 1.0]])
TURN = torch.tensor([[0.8, 0.0, 0.6, 0.3], [0.0, 1.0, 0.0, -0.2], [-0.6, 0.0, 0.8, 0.5], [0.0, 0.0, 0.0, 1.0]])
"""World to camera."""


def one(center: tuple[float, float, float], scales: tuple[float, float, float], opacity: float = 0.9) -> Gaussians:
    """A Gaussian at a place in the camera's coordinates."""
    place = TURN[:3, :3].T @ (torch.tensor(center) - TURN[:3, 3])
    quat = torch.tensor([[0.9, 0.1, -0.3, 0.2]])
    return Gaussians(place[None], quat, torch.tensor([scales]), torch.tensor([opacity]), torch.ones(1, 3))


@pytest.mark.parametrize("opacity", [0.9, 0.3])
@pytest.mark.parametrize("center", [(0.0, 0.0, 2.0), (0.6, -0.9, 2.0), (1.0, 1.0, 1.0)])
def test_what_is_drawn_is_what_the_rasterizer_draws(center: tuple[float, float, float], opacity: float) -> None:
    gaussian = one(center, (0.3, 0.2, 0.1), opacity)
    _, alpha, _ = rasterizer("reference", "cpu")(
        *gaussian, viewmats=TURN[None], Ks=K[None], width=WIDTH, height=HEIGHT, near_plane=0.01
    )
    drawn = areas(gaussian, TURN, K, WIDTH, HEIGHT).drawn
    assert drawn.item() == pytest.approx(alpha.sum().item(), rel=0.02)


def test_a_gaussian_as_thin_as_a_pixel_is_drawn_with_what_the_rasterizer_adds_to_its_size() -> None:
    gaussian = one((0.0, 0.0, 2.0), (0.3, 0.004, 0.004))
    _, alpha, _ = rasterizer("reference", "cpu")(
        *gaussian, viewmats=TURN[None], Ks=K[None], width=WIDTH, height=HEIGHT, near_plane=0.01
    )
    assert areas(gaussian, TURN, K, WIDTH, HEIGHT).drawn.item() == pytest.approx(alpha.sum().item(), rel=0.05)


def test_a_small_gaussian_in_the_frame_is_drawn_as_it_is_seen() -> None:
    """The area of a ball of standard deviation s is 2 pi (s f / z)^2 times its opacity, less what is not drawn."""
    seen, drawn = areas(one((0.0, 0.0, 2.0), (0.1, 0.1, 0.1)), TURN, K, WIDTH, HEIGHT)
    expected = 2 * math.pi * (0.1 * 170 / 2) ** 2 * (0.9 - 1 / 255)
    assert seen.item() == pytest.approx(expected, rel=0.01)
    assert drawn.item() == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("opacity", [0.9, 0.3])
def test_seen_is_the_largest_density_along_each_ray(opacity: float) -> None:
    gaussian = one((1.3, 1.0, 1.0), (0.3, 0.2, 0.4), opacity)
    w, x, y, z = torch.nn.functional.normalize(gaussian.quats[0], dim=0).tolist()
    turn = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    rows, columns = torch.arange(2.0, HEIGHT, 4), torch.arange(2.0, WIDTH, 4)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    rays = torch.stack([(u - 80) / 170, (v - 120) / 170, torch.ones_like(u)], dim=-1)
    largest = torch.zeros_like(u)
    for depth in torch.linspace(0.02, 4, 400):
        world = (rays * depth - TURN[:3, 3]) @ TURN[:3, :3]
        offset = (world - gaussian.means[0]) @ turn / gaussian.scales[0]
        largest = torch.maximum(largest, opacity * torch.exp(-offset.square().sum(dim=-1) / 2))
    expected = 16 * largest[largest > 1 / 255].sum()
    assert areas(gaussian, TURN, K, WIDTH, HEIGHT).seen.item() == pytest.approx(expected.item(), rel=0.02)


def test_of_a_large_gaussian_beside_the_frame_several_times_as_much_is_drawn_as_is_seen() -> None:
    seen, drawn = areas(one((0.75, 1.1, 1.0), (0.1, 0.3, 0.3)), TURN, K, WIDTH, HEIGHT)
    assert seen > 10
    assert drawn > 3 * seen


def test_only_what_is_outside_the_frame_and_in_front_counts_as_beside_it() -> None:
    places = torch.tensor([[0.5, 0.5], [1.2, 0.5], [0.5, -0.1], [1.4, 1.4], [0.2, 3.0], [0.5, 1.1]])
    depths = torch.tensor([1.0, 2.0, 1.0, -1.0, 0.0, 4.0])
    scales = torch.tensor([9.0, 0.4, 0.3, 9.0, 9.0, 0.4])
    assert beside(places, depths, scales, 5).tolist() == [2, 1, 5]
    assert beside(places, depths, scales, 1).tolist() == [2]
    assert beside(places[:1], depths[:1], scales[:1], 5).numel() == 0


def test_nothing_behind_a_camera_is_seen() -> None:
    assert areas(one((0.0, 0.0, -2.0), (0.5, 0.5, 0.5)), TURN, K, WIDTH, HEIGHT).seen == 0


def test_a_missing_run_is_named_in_one_line(tmp_path) -> None:
    command = [sys.executable, "benchmarks/beside_the_frame.py", "--load-config", str(tmp_path / "config.yml")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "config.yml is no file" in ended.stderr
    assert len(ended.stderr.strip().splitlines()) == 1
