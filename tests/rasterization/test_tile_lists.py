"""Lists of tiles with a given number of entries against what gsplat lists, entry by entry."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssa_nerfstudio.rasterization.tile_lists import TileLists, entries_of, grid_of, list_tiles


def splats(count: int, width: int, height: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Centers, radii and depths, some outside of the image, some not drawn, some equally far."""
    generator = torch.Generator().manual_seed(seed)
    centers = (torch.rand(count, 2, generator=generator) * 1.6 - 0.3) * torch.tensor([width, height])
    radii = torch.randint(-3, 40, (count,), generator=generator).clamp(min=0).int()
    return centers, radii, torch.randint(1, 9, (count,), generator=generator) / 4


def expected(centers: Tensor, radii: Tensor, depths: Tensor, width: int, height: int) -> dict[tuple[int, int], list]:
    """A list for each tile (row, column), by gsplat's rule for one Gaussian after the other."""
    columns, rows = math.ceil(width / 16), math.ceil(height / 16)
    lists: dict[tuple[int, int], list] = {(row, column): [] for row in range(rows) for column in range(columns)}
    for i in sorted(range(len(radii)), key=lambda i: (float(depths[i]), i)):
        x, y, radius = (float(value) / 16 for value in (*centers[i], radii[i]))
        if radius <= 0:
            continue
        for row in range(max(0, math.floor(y - radius)), min(rows, math.ceil(y + radius))):
            for column in range(max(0, math.floor(x - radius)), min(columns, math.ceil(x + radius))):
                lists[row, column].append(i)
    return lists


def taken_apart(lists: TileLists) -> dict[tuple[int, int], list]:
    """The list of each tile that is drawn, as gsplat's kernels find it."""
    _, rows, columns = lists.offsets.shape
    starts = [*lists.offsets.flatten().tolist(), len(lists.gaussians)]
    return {
        divmod(tile, columns): lists.gaussians[starts[tile] : starts[tile + 1]].tolist()
        for tile in range(rows * columns)
        if lists.drawn.flatten()[tile]
    }


sizes = st.integers(1, 90)


@given(count=st.integers(1, 60), width=sizes, height=sizes, room=st.integers(0, 300), seed=st.integers(0, 99))
def test_every_tile_lists_what_gsplat_does(count: int, width: int, height: int, room: int, seed: int) -> None:
    made = splats(count, width, height, seed)
    oracle = expected(*made, width, height)
    needed = sum(map(len, oracle.values()))
    lists = list_tiles(*made, width, height, needed + room)
    assert int(lists.needed) == needed == int(entries_of(*made[:2], width, height)[1].prod(dim=1).sum())
    assert len(lists.gaussians) == needed + room
    assert lists.gaussians.dtype == lists.offsets.dtype == torch.int32
    assert taken_apart(lists) == oracle


def test_what_is_left_over_belongs_to_no_tile_that_is_drawn() -> None:
    made = splats(40, 50, 40, 1)
    lists = list_tiles(*made, 50, 40, 5000)
    columns, rows = grid_of(50, 40)
    assert lists.drawn.shape == lists.offsets.shape == (1, rows + 1, columns)
    assert lists.drawn[:, :rows].all()
    assert not lists.drawn[:, rows:].any()
    assert (lists.offsets[0, rows, 0] == lists.needed).all()
    assert lists.gaussians.min() >= 0, "kernels may read what they do not draw"
    assert lists.gaussians.max() < 40


@pytest.mark.parametrize("capacity", [1, 100])
def test_lists_that_are_too_short_say_what_is_needed(capacity: int) -> None:
    made = splats(60, 80, 70, 2)
    lists = list_tiles(*made, 80, 70, capacity)
    assert int(lists.needed) == sum(map(len, expected(*made, 80, 70).values())) > capacity
    assert len(lists.gaussians) == capacity
    assert lists.offsets.min() >= 0
    assert lists.offsets.max() <= capacity


def test_a_frame_of_more_tiles_than_short_keys_hold() -> None:
    centers, radii, depths = splats(30, 4000, 3000, 3)
    radii[0] = 9000  # in every tile
    assert math.prod(grid_of(4000, 3000)) > torch.iinfo(torch.int16).max
    oracle = expected(centers, radii, depths, 4000, 3000)
    assert all(oracle.values())
    assert taken_apart(list_tiles(centers, radii, depths, 4000, 3000, 60_000)) == oracle


def test_nothing_in_front_of_the_camera() -> None:
    centers, radii, depths = splats(20, 50, 40, 4)
    lists = list_tiles(centers, torch.zeros_like(radii), depths, 50, 40, 10)
    assert int(lists.needed) == 0
    assert not any(taken_apart(lists).values())
