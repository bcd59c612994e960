"""Points in the gaps between a scene's points, at the depth of those around: plain walls, roads, a bright ceiling.

Structure from motion finds no points where there is nothing to match. Splats grow into such a gap from its border, and
meanwhile an overlay learns what they do not show.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy.spatial import KDTree
from torch import Tensor

from ssa_nerfstudio.evidence.point_samples import regular_subset, visible
from ssa_nerfstudio.evidence.scene_photos import ScenePhoto, near_points
from ssa_nerfstudio.evidence.seeds import Seeds

SPACING = 4
"""Of the seeds in a photo, working pixels, and the distance that no point is within."""
NEIGHBORS = 8
"""Visible points around a seed, through which a plane gives its depth."""
FLATNESS = 0.1
"""Weight of a constant depth beside that plane's slope: neighbors on one line say nothing about the other direction."""
MAX_VIEWS = 32
"""Photos whose gaps are filled: neighboring ones show the same."""


@torch.no_grad()
def gap_points(points: Tensor, photos: Sequence[ScenePhoto]) -> Seeds:
    """Fill what photos show between points. Photo by photo, with the seeds of those before as further points.

    Args:
        points: of the scene [P, 3], world units, finite; at least one.
        photos: at least one.

    Returns:
        The seeds, on the device of the points; there may be none.
    """
    points = regular_subset(points, MAX_VIEWS)
    found = [Seeds.none(points)]
    for photo in photos[:: -(-len(photos) // MAX_VIEWS)]:
        seeds = _seeds_in(photo, points)
        points = torch.cat([points, seeds.positions])
        found.append(seeds)
    return Seeds.joined(*found)


def _seeds_in(photo: ScenePhoto, points: Tensor) -> Seeds:
    """Those in the gaps of one photo."""
    width, reduction = photo.size[1], photo.reduction
    row, column = _gaps(points, photo)
    seen = visible(points, [photo.view], reduction, photo.size)
    if not len(row) or len(seen.pixel) < NEIGHBORS:
        return Seeds.none(points)
    of_points = torch.stack([seen.pixel // width, seen.pixel % width], dim=-1)
    depth = _depth(torch.stack([row, column], dim=-1), of_points, seen.depth)[:, None]
    pose, lens = photo.view.world_to_camera.to(points), photo.view.intrinsics.to(points)
    # On the host: on a GPU the inverse would load a library for it.
    inverse = torch.linalg.inv(photo.view.intrinsics.cpu()).to(points)
    pixel = torch.stack([(column + 0.5) * reduction, (row + 0.5) * reduction, torch.ones_like(depth[:, 0])], dim=-1)
    in_camera = depth * (pixel.to(points) @ inverse.mT)
    positions = (in_camera - pose[:3, 3]) @ pose[:3, :3]
    colors = photo.color[row.to(photo.color.device), column.to(photo.color.device)].to(points)
    return Seeds(positions, colors, SPACING * reduction / lens[0, 0] * depth[:, 0])


def _depth(gaps: Tensor, places: Tensor, depths: Tensor) -> Tensor:
    """Depths [G] at pixels [G, 2], of planes through the NEIGHBORS nearest of pixels [M, 2] with depths [M].

    The inverse depth of a plane is linear in the frame. It is not extrapolated beyond that of the neighbors.
    """
    _, nearest = KDTree(places.cpu().numpy()).query(gaps.cpu().numpy(), k=NEIGHBORS)
    nearest = torch.from_numpy(nearest).to(depths.device)
    inverse = 1 / depths[nearest]
    offset = (places[nearest] - gaps[:, None]).to(inverse)
    mean, middle = inverse.mean(dim=1), offset.mean(dim=1)
    offset = offset - middle[:, None]
    (xx, yy), xy = offset.square().sum(dim=1).unbind(dim=-1), offset.prod(dim=-1).sum(dim=1)
    x, y = (offset * (inverse - mean[:, None])[..., None]).sum(dim=1).unbind(dim=-1)
    flat = FLATNESS * (middle.square().sum(dim=-1) + (xx + yy) / NEIGHBORS)
    xx, yy = xx + flat, yy + flat
    slope = torch.stack([yy * x - xy * y, xx * y - xy * x], dim=-1) / (xx * yy - xy * xy)[:, None]
    return 1 / (mean - (slope * middle).sum(dim=-1)).clamp(inverse.amin(dim=1), inverse.amax(dim=1))


def _gaps(points: Tensor, photo: ScenePhoto) -> tuple[Tensor, Tensor]:
    """Rows and columns [G] of a grid of working pixels that show the scene, without points around, hidden or not."""
    free = photo.shown[..., 0].to(points.device) & ~near_points(points, photo, SPACING)
    row, column = free[SPACING // 2 :: SPACING, SPACING // 2 :: SPACING].nonzero(as_tuple=True)
    return SPACING // 2 + SPACING * row, SPACING // 2 + SPACING * column
