"""Which Gaussians each tile draws, nearest first, in lists that together have a given number of entries.

gsplat's own lists are as long as a view needs, for which the host waits, and which a CUDA graph cannot repeat. The
entries and their order are gsplat's (cuda/csrc/isect_tiles.cu).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ssa_nerfstudio.rasterization.constants import TILE


class TileLists(NamedTuple):
    """Lists of one camera, as gsplat's blending reads them: of a grid with one more row of tiles, which is not drawn.

    That row has the entries that are left over.
    """

    offsets: Tensor  # [1, rows + 1, columns] int32, first entry of each tile's list, which ends where the next begins
    gaussians: Tensor  # [capacity] int32
    drawn: Tensor  # [1, rows + 1, columns] bool
    needed: Tensor  # [] int64, entries that there should be: with more than the capacity the lists are wrong


def grid_of(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of the tiles of an image, pixels."""
    return math.ceil(width / TILE), math.ceil(height / TILE)


def entries_of(means2d: Tensor, radii: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """First tile (column, row) and number of tiles (columns, rows), both [N, 2] int32, that Gaussians are drawn in.

    Args:
        means2d: [N, 2], pixels.
        radii: [N] int32, pixels; 0 where nothing is drawn.
        width, height: of the image, pixels.
    """
    reach = radii[:, None]
    low, high = ((means2d - reach) / TILE).floor(), ((means2d + reach) / TILE).ceil()
    edges = [
        torch.stack([corner[:, axis].clamp(0, size) for axis, size in enumerate(grid_of(width, height))], dim=1).int()
        for corner in (low, high)
    ]
    return edges[0], torch.where(reach > 0, edges[1] - edges[0], 0)


@torch.no_grad()
def list_tiles(means2d: Tensor, radii: Tensor, depths: Tensor, width: int, height: int, capacity: int) -> TileLists:
    """List the Gaussians of each tile without the host knowing how many there are.

    Gaussians are sorted by depth first, and then entries by tile alone, which is one sort of few and one of short keys.

    Args:
        means2d, radii, width, height: as of `entries_of`.
        depths: [N].
        capacity: number of entries of all lists together.
    """
    (columns, rows), device = grid_of(width, height), means2d.device
    first, size = entries_of(means2d, radii, width, height)
    order = depths.sort(stable=True).indices
    first, size = first[order], size[order]
    counts = size.prod(dim=1)
    ends = counts.cumsum(dim=0)
    slots = torch.arange(capacity, dtype=torch.int32, device=device)
    rank = torch.searchsorted(ends.clamp(max=capacity).int(), slots, right=True, out_int32=True)
    rank = rank.clamp(max=len(order) - 1)
    place = (slots - (ends - counts)[rank]).int()
    across = size[:, 0].clamp(min=1)[rank]
    tile = (first[:, 1][rank] + place // across) * columns + first[:, 0][rank] + place % across
    tile = torch.where(slots < ends[-1], tile, rows * columns)
    kind = torch.int16 if (rows + 1) * columns <= torch.iinfo(torch.int16).max else torch.int32
    tile, entries = tile.to(kind).sort(stable=True)
    tiles = torch.arange((rows + 1) * columns, dtype=kind, device=device)
    drawn = torch.arange(rows + 1, device=device)[:, None].expand(-1, columns) < rows
    return TileLists(
        torch.searchsorted(tile, tiles, out_int32=True).view(1, rows + 1, columns),
        order[rank[entries]].int(),
        drawn[None].contiguous(),
        ends[-1],
    )
