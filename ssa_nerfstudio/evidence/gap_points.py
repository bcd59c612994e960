"""Points in the gaps between a scene's points, at the depth of those around: plain walls, roads, a bright ceiling.

Structure from motion finds no points where there is nothing to match. Splats grow into such a gap from its border, and
meanwhile an overlay learns what they do not show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from scipy.spatial import ConvexHull, KDTree, QhullError
from torch import Tensor

from ssa_nerfstudio.evidence.distant_points import Sphere
from ssa_nerfstudio.evidence.nearest_depths import nearest_depths
from ssa_nerfstudio.evidence.point_samples import (
    OCCLUSION_TOLERANCE,
    View,
    project,
    regular_subset,
    visible,
    working_pixels,
)
from ssa_nerfstudio.evidence.scene_photos import ScenePhoto, near_points
from ssa_nerfstudio.evidence.seeds import Seeds

SPACING = 4
"""Of the seeds in a photo, working pixels, and the distance that no point is within."""
NEIGHBORS = 8
"""Visible points around a seed, through which a plane gives its depth."""
FLATNESS = 0.1
"""Weight of a constant depth beside that plane's slope: neighbors on one line say nothing about the other direction."""
CLEAR_BY = 2 * OCCLUSION_TOLERANCE
"""A seed hides points of a photo if all those around it are farther by more than this share of its depth."""
MAX_VIEWS = 32
"""Photos whose gaps are filled: neighboring ones show the same."""


@torch.no_grad()
def gap_points(points: Tensor, photos: Sequence[ScenePhoto], far: Sphere) -> tuple[Seeds, Seeds]:
    """Fill the frames between points, at their depth, photo by photo, with the seeds of those before as further points.

    Where points are not all around, as in the corner of a room beyond the last one, nothing tells the depth, and there
    are no seeds. One that hides points in the frame of another photo is at a wrong depth, as beside the outline of
    something near, and is left out.

    Then what a photo hides, because of an opaque artifact or a mask, where there are neither points nor seeds: probably
    no photo shows it. It continues the colors around, far away, because splats that photos show may be there.

    Args:
        points: of the scene [P, 3], world units, finite; at least one.
        photos: at least one.
        far: beyond the scene.

    Returns:
        The seeds that photos show, and those that they hide, on the device of the points; there may be none.
    """
    points = regular_subset(points, MAX_VIEWS)
    photos = photos_to_fill(photos)
    taken, found = points, []
    for part in (partial(_between, spaces=_free_spaces(points, photos)), partial(_behind, far=far)):
        seeds = []
        for photo in photos:
            seeds.append(part(photo, taken))
            taken = torch.cat([taken, seeds[-1].positions])
        found.append(Seeds.joined(*seeds))
    return found[0], found[1]


def photos_to_fill(photos: Sequence[ScenePhoto]) -> Sequence[ScenePhoto]:
    """Those whose gaps are filled: a regular subset of at most MAX_VIEWS."""
    return photos[:: -(-len(photos) // MAX_VIEWS)]


def _between(photo: ScenePhoto, taken: Tensor, spaces: Sequence[_FreeSpace]) -> Seeds:
    """Seeds in the gaps that a photo shows, at the depth of positions [P, 3] around."""
    gaps = _gaps(photo, taken, photo.shown[..., 0])
    if not len(gaps):
        return Seeds.none(taken)
    seen = visible(taken, [photo.view], photo.reduction, photo.size)
    if len(seen.pixel) < NEIGHBORS:
        return Seeds.none(taken)
    width = photo.size[1]
    places = torch.stack([seen.pixel // width, seen.pixel % width], dim=-1)
    gaps = gaps[_in_hull(gaps, places)]
    if not len(gaps):
        return Seeds.none(taken)
    depth = _depth(gaps, places, seen.depth)
    camera, rays = _rays(photo, gaps, taken)
    color = photo.color[tuple(gaps.to(photo.color.device).mT)]
    seeds = Seeds(camera + depth[:, None] * rays, color.to(taken), _width(photo) * depth)
    return seeds.subset(~_hide_points(seeds.positions, spaces))


def _behind(photo: ScenePhoto, taken: Tensor, far: Sphere) -> Seeds:
    """Seeds far away in the gaps that a photo hides."""
    gaps, shown = _gaps(photo, taken, photo.hidden[..., 0]), _on_grid(photo.shown[..., 0]).nonzero()
    if not len(gaps) or len(shown) < NEIGHBORS:
        return Seeds.none(taken)
    around = shown[_nearest(gaps.to(shown.device), shown)]
    color = photo.color[around[..., 0], around[..., 1]].mean(dim=1)
    camera, rays = _rays(photo, gaps, taken)
    depth = far.depths(camera, rays)
    return Seeds(camera + depth[:, None] * rays, color.to(taken), _width(photo) * depth)


def _gaps(photo: ScenePhoto, taken: Tensor, where: Tensor) -> Tensor:
    """Row and column [G, 2] of those pixels of the grid, `where` [h, w] is True, that have no position [P, 3] around,
    hidden or not."""
    return _on_grid(where.to(taken.device) & ~near_points(taken, [photo], SPACING)[0][..., 0]).nonzero()


def _on_grid(mask: Tensor) -> Tensor:
    """A mask [h, w] at every SPACING-th working pixel; elsewhere False."""
    grid = torch.zeros_like(mask)
    grid[SPACING // 2 :: SPACING, SPACING // 2 :: SPACING] = mask[SPACING // 2 :: SPACING, SPACING // 2 :: SPACING]
    return grid


def _rays(photo: ScenePhoto, pixels: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
    """Position [3] of a camera, and rays [G, 3] of depth 1 through working pixels [G, 2], as a tensor is stored."""
    # On the host: on a GPU the inverse would load a library for it.
    inverse = torch.linalg.inv(photo.view.intrinsics.cpu()).to(like)
    place = torch.cat([(pixels.flip(-1) + 0.5) * photo.reduction, torch.ones_like(pixels[:, :1])], dim=-1)
    rotation = photo.view.world_to_camera[:3, :3].to(like)
    return photo.view.position.to(like), place.to(like) @ inverse.mT @ rotation


def _width(photo: ScenePhoto) -> float:
    """Distance of neighboring seeds at depth 1."""
    return SPACING * photo.reduction / float(photo.view.intrinsics[0, 0])


@dataclass(frozen=True)
class _FreeSpace:
    """How far V photos of one size see."""

    poses: Tensor
    """World to camera [V, 4, 4]."""
    lenses: Tensor
    """Intrinsics [V, 3, 3]."""
    size: tuple[int, int]
    """Height and width of the working frame."""
    reduction: int
    """Photo pixels a working pixel."""
    depths: Tensor
    """[V, h w], to the nearest point around each working pixel; infinite where there is none."""


def _free_spaces(points: Tensor, photos: Sequence[ScenePhoto]) -> list[_FreeSpace]:
    """Of photos of each size."""
    alike: dict[tuple[tuple[int, int], int], list[View]] = {}
    for photo in photos:
        alike.setdefault((photo.size, photo.reduction), []).append(photo.view)
    spaces = []
    for (size, reduction), views in alike.items():
        poses = torch.stack([view.world_to_camera for view in views])
        lenses = torch.stack([view.intrinsics for view in views])
        camera, _, position, depth = project(points, poses, lenses, size[0] * reduction, size[1] * reduction)
        depths = nearest_depths(camera, working_pixels(position, size, reduction), depth, (len(views), *size))
        spaces.append(_FreeSpace(poses, lenses, size, reduction, depths))
    return spaces


def _hide_points(positions: Tensor, spaces: Sequence[_FreeSpace]) -> Tensor:
    """[N] bool: whether a position [N, 3] is before all points around it in the frame of one of the photos."""
    hide = torch.zeros_like(positions[:, 0], dtype=torch.bool)
    for space in spaces:
        size = space.size[0] * space.reduction, space.size[1] * space.reduction
        camera, index, position, depth = project(positions, space.poses, space.lenses, *size)
        behind = space.depths[camera, working_pixels(position, space.size, space.reduction)]
        hide[index[(behind > depth * (1 + CLEAR_BY)) & behind.isfinite()]] = True
    return hide


def _in_hull(gaps: Tensor, places: Tensor) -> Tensor:
    """[G] bool: whether a pixel [G, 2] is between others [M, 2], in their convex hull; on one line nothing is."""
    # The hull of all is that of the two ends of each row.
    rows, columns = places.cpu().unbind(dim=-1)
    height = int(rows.max()) + 1
    filled = (torch.bincount(rows, minlength=height) > 0).nonzero()[:, 0]
    unset = columns.new_zeros(height)
    ends = [unset.scatter_reduce(0, rows, columns, end, include_self=False) for end in ("amin", "amax")]
    outline = torch.cat([torch.stack([filled, end[filled]], dim=-1) for end in ends])
    try:
        sides = torch.from_numpy(ConvexHull(outline.numpy()).equations)
    except QhullError:
        return torch.zeros_like(gaps[:, 0], dtype=torch.bool)
    inside = gaps.cpu().to(sides) @ sides[:, :2].mT + sides[:, 2] <= 1e-9
    return inside.all(dim=1).to(gaps.device)


def _nearest(gaps: Tensor, places: Tensor) -> Tensor:
    """Indices [G, NEIGHBORS] of the pixels [M, 2] nearest to pixels [G, 2], on the device of these."""
    _, nearest = KDTree(places.cpu().numpy()).query(gaps.cpu().numpy(), k=NEIGHBORS)
    return torch.from_numpy(nearest).to(gaps.device)


def _depth(gaps: Tensor, places: Tensor, depths: Tensor) -> Tensor:
    """Depths [G] at pixels [G, 2], of planes through the NEIGHBORS nearest of pixels [M, 2] with depths [M].

    The inverse depth of a plane is linear in the frame. It is not extrapolated beyond that of the neighbors.
    """
    nearest = _nearest(gaps, places)
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
