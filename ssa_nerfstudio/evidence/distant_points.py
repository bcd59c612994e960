"""Points of the scene far away where structure from motion found none: a sky, clouds, distant hills.

A scene starts from its points, an overlay at every pixel. Where there are no points, splats must first grow into the
frame, and meanwhile the overlay learns what they do not show: on a walk a sky hardly moves in the frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor, nn

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.point_samples import (
    OCCLUSION_RADIUS,
    View,
    order_by_point,
    project,
    regular_subset,
    summed,
    working_pixels,
    working_reduction,
)
from ssa_nerfstudio.evidence.statistics import FULL_SCALE

SPACING = 2.0
"""Of neighboring directions, working pixels."""
MAX_DIRECTIONS = 2**18
"""Of the whole sphere; a telephoto lens, whose pixels are smaller, has a larger spacing."""
DISTANCE = 3.0
"""Of the distant points, relative to that of the 99th percentile of the scene's points, from the cameras' mean."""
NEARER = (0.5, 0.9, 0.99)
"""Quantiles of the scene's points whose distances are the alternatives: there are the scene's surfaces."""
NOISE = 0.05
"""Difference of colors, mean over channels, that costs half of what an outlier does: leaves that a sky is seen through
say nothing about it."""
MIN_DIRECTIONS = 30
"""Of an area that can be compared with nearer distances; among fewer one distance is the best by chance."""
MIN_SIGHTS = 3
"""Views that must see a direction: the fewest of which a median leaves one out."""
MAX_VIEWS = 128
"""Views that are read; of more a regular subset."""
MIN_SHOWN = 0.5
"""Transmittance of the artifact below which a pixel does not count."""


@dataclass(frozen=True)
class DistantPoints:
    """Points on a sphere around the cameras."""

    positions: Tensor
    """[N, 3], world units."""
    colors: Tensor
    """[N, 3] in [0, 1]."""
    spacing: float
    """Distance of neighbors, world units."""

    def __len__(self) -> int:
        return len(self.positions)

    def table(self) -> Tensor:
        """[N, 7], for a checkpoint: positions, colors and the spacing."""
        return torch.cat([self.positions, self.colors, torch.full_like(self.positions[:, :1], self.spacing)], dim=-1)

    @classmethod
    def of_table(cls, table: Tensor) -> DistantPoints:
        """The points of a `table` of at least one."""
        return cls(table[:, :3], table[:, 3:6], float(table[0, 6]))


@torch.no_grad()
def distant_points(
    points: Tensor,
    views: Sequence[View],
    layers: Sequence[tuple[Tensor, Tensor] | None],
    groups: Sequence[int],
    artifact_is_exposed: bool = False,
) -> tuple[DistantPoints, DistantPoints]:
    """Find directions in which the photos show something far away, and no point is seen.

    A direction is a candidate if half of the views that show it see none of the scene's points around it, and if one
    color for it explains these photos at least as well as one color for each of their pixels does: what stands still in
    the frame is an artifact. A connected area of candidates is far away if that explains its photos better than any
    distance does at which the scene has its points: what is nearer has parallax. Where cameras are too close together
    to have any, nothing speaks against it. Costs are robust, because something nearer may hide a direction from some of
    the views. A direction that fewer than MIN_SIGHTS of the views show, because of an artifact or a mask, continues
    what is seen nearest to it.

    Args:
        points: of the scene [P, 3], world units, finite; at least one.
        views: at least one.
        layers: of each view's artifact, T [H, W, 1 or 3] and B [H, W, 3]; None where it has none. Views with the same
            artifact have the same tuple.
        groups: of each view: views of one group have the same camera and the same artifact.
        artifact_is_exposed: views' gains act on scene and artifact together, and not on the scene alone.

    Returns:
        The points that photos show, and those that they hide, on the device of the scene's; there may be none.
    """
    every = -(-len(views) // MAX_VIEWS)
    kept = [view for group in sorted({*groups}) for view in _members(groups, group)[::every]]
    views, layers = [views[view] for view in kept], [layers[view] for view in kept]
    groups = [groups[view] for view in kept]
    points = regular_subset(points, len(views))
    poses = torch.stack([view.world_to_camera for view in views])
    cameras = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0].to(points)
    center = cameras.mean(dim=0)
    baseline = float((cameras - center).norm(dim=1).max())
    distances = (points - center).norm(dim=1)
    nearer = [float(distances.kthvalue(math.ceil(share * len(points))).values) for share in NEARER]
    radius = DISTANCE * nearer[-1]
    of_views = {id(pair): _reduced_layers(pair, view) for pair, view in zip(layers, views, strict=True) if pair}
    scenes = [
        _scene_in(view, of_views.get(id(pair)), artifact_is_exposed) for view, pair in zip(views, layers, strict=True)
    ]
    angles = [scene.reduction / float(view.intrinsics[0, 0]) for scene, view in zip(scenes, views, strict=True)]
    angle = max(SPACING * sum(angles) / len(angles), math.sqrt(4 * math.pi / MAX_DIRECTIONS))
    directions = _directions(round(4 * math.pi / angle**2)).to(points)
    taken = [_near_points(points, view, scene) for view, scene in zip(views, scenes, strict=True)]
    frames = list(zip(views, scenes, taken, _still_pictures(scenes, groups), strict=True))
    far = _explanation(center + radius * directions, frames)
    shown = far.shown >= MIN_SIGHTS
    likely = shown & (far.sights >= MIN_SIGHTS) & (2 * far.sights >= far.shown) & (far.residual <= far.still)
    candidates = likely.nonzero()[:, 0]
    if not len(candidates):
        nothing = DistantPoints(directions[:0], directions[:0], radius * angle)
        return nothing, nothing
    nearer = [at for at in nearer if at > 0 and baseline * (1 / at - 1 / radius) > angle]
    alternatives = [_explanation(center + at * directions[candidates], frames) for at in nearer]
    areas = _connected(directions[candidates], 1.5 * angle)
    found = torch.zeros_like(shown)
    found[candidates[_distant(areas, far.residual[candidates], alternatives)]] = True
    behind = ((far.in_frame >= MIN_SIGHTS) & ~shown).nonzero()[:, 0]
    seen = shown.nonzero()[:, 0]
    _, nearest = KDTree(directions[seen].cpu().numpy()).query(directions[behind].cpu().numpy())
    source = seen[torch.from_numpy(np.asarray(nearest, dtype=np.int64)).to(seen)]
    behind, source = behind[found[source]], source[found[source]]
    return (
        DistantPoints(center + radius * directions[found], far.median[found], radius * angle),
        DistantPoints(center + radius * directions[behind], far.median[source], radius * angle),
    )


@dataclass(frozen=True)
class _Scene:
    """What a photo shows of the scene, at the working resolution."""

    color: Tensor
    """[h, w, 3]."""
    shown: Tensor
    """[h, w, 1] bool: no mask and no opaque artifact is there."""
    reduction: int
    """Photo pixels a working pixel."""


@dataclass(frozen=True)
class _Explanation:
    """How well points of one color each explain the photos."""

    median: Tensor
    """[N, 3]: their colors."""
    residual: Tensor
    """[N] in [0, 1): mean cost of the photos' differences d from it, d / (d + NOISE)."""
    still: Tensor
    """[N]: that from one color for each pixel, the photos' mean."""
    sights: Tensor
    """[N] int64: views that show a point, and none of the scene's points near it: those that count."""
    shown: Tensor
    """[N] int64: views that show a point."""
    in_frame: Tensor
    """[N] int64: views with a point in the frame."""


def _distant(area: Tensor, far: Tensor, alternatives: Sequence[_Explanation]) -> Tensor:
    """Whether directions are of a connected area that is explained better far away than at any alternative, bool [N].

    Only directions that MIN_SIGHTS views see at every alternative count. Among few directions one distance is the best
    by chance, as on a plain wall; and a small area needs no points, because splats grow into it from beside it.

    Args:
        area: number of each direction's area [N].
        far: their residuals far away, [N].
        alternatives: the directions nearer by; none where nothing has parallax.
    """
    comparable = torch.ones_like(area, dtype=torch.bool)
    for other in alternatives:
        comparable &= other.sights >= MIN_SIGHTS
    values = torch.stack([torch.ones_like(far), far, *(other.residual for other in alternatives)], dim=-1)
    totals = summed(area, torch.where(comparable[:, None], values, 0), int(area.max()) + 1)
    size, far_away, nearer = totals.split((1, 1, len(alternatives)), dim=1)
    return ((size[:, 0] >= MIN_DIRECTIONS) & (far_away < nearer).all(dim=1))[area]


def _members(groups: Sequence[int], group: int) -> list[int]:
    return [view for view, of in enumerate(groups) if of == group]


def _directions(count: int) -> Tensor:
    """Unit vectors [N, 3], evenly over all directions (a Fibonacci lattice)."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * number / count, math.pi * (1 + math.sqrt(5)) * number
    radius = (1 - height**2).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], dim=-1)


def _connected(directions: Tensor, angle: float) -> Tensor:
    """Number of the connected area of each direction [N], of neighbors within an angle (radians)."""
    pairs = KDTree(directions.cpu().numpy()).query_pairs(angle, output_type="ndarray")
    linked = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=2 * (len(directions),))
    return torch.from_numpy(connected_components(linked, directed=False)[1].astype(np.int64)).to(directions.device)


def _reduced_layers(layers: tuple[Tensor, Tensor], view: View) -> tuple[Tensor, Tensor]:
    """T [h, w, 1] and B [h, w, 3] at the working resolution, on the device of the photos."""
    reduction = working_reduction(*view.image.shape[:2])
    transmittance, addition = (reduced(layer, reduction).to(view.image.device) for layer in layers)
    return transmittance.mean(dim=-1, keepdim=True), addition


def _scene_in(view: View, layers: tuple[Tensor, Tensor] | None, artifact_is_exposed: bool) -> _Scene:
    height, width = view.image.shape[:2]
    reduction = working_reduction(height, width)
    color = reduced(view.image[..., :3].float(), reduction) / FULL_SCALE.get(view.image.dtype, 1.0)
    gain = torch.ones_like(color[0, 0]) if view.gain is None else view.gain.to(color)
    shown = torch.ones_like(color[..., :1], dtype=torch.bool)
    if view.mask is not None:
        shown &= reduced((view.mask.reshape(height, width, 1) != 0).to(color), reduction) == 1
    if layers is not None:
        transmittance, addition = layers
        shown &= transmittance >= MIN_SHOWN
        color = color - (gain if artifact_is_exposed else 1.0) * addition
        color = color / transmittance.clamp_min(MIN_SHOWN)
    return _Scene((color / gain).clamp(0, 1), shown, reduction)


def _still_pictures(scenes: Sequence[_Scene], groups: Sequence[int]) -> list[Tensor]:
    """For each scene the mean over those of its group and size, [h w, 3]."""
    keys = [(group, scene.shown.shape) for scene, group in zip(scenes, groups, strict=True)]
    totals: dict[tuple[int, torch.Size], Tensor] = {}
    for key, scene in zip(keys, scenes, strict=True):
        total = torch.cat([scene.color * scene.shown, scene.shown.to(scene.color)], dim=-1).reshape(-1, 4)
        totals[key] = totals[key] + total if key in totals else total
    means = {key: total[:, :3] / total[:, 3:].clamp_min(1) for key, total in totals.items()}
    return [means[key] for key in keys]


def _pixels(positions: Tensor, view: View, scene: _Scene) -> tuple[Tensor, Tensor]:
    """Indices [M] of the positions [N, 3] in the frame of a view, and their working pixels [M], row by row."""
    height, width = scene.shown.shape[:2]
    size = height * scene.reduction, width * scene.reduction
    _, index, position, _ = project(positions, view.world_to_camera[None], view.intrinsics[None], *size)
    return index, working_pixels(position, (height, width), scene.reduction)


def _near_points(points: Tensor, view: View, scene: _Scene) -> Tensor:
    """[h w] bool: one of the scene's points is in the working pixel or around it."""
    height, width = scene.shown.shape[:2]
    taken = torch.zeros(height * width, device=points.device)
    taken[_pixels(points, view, scene)[1]] = 1
    side = 2 * OCCLUSION_RADIUS + 1
    return nn.functional.max_pool2d(taken.reshape(1, height, width), side, 1, OCCLUSION_RADIUS).flatten() > 0


def _explanation(positions: Tensor, frames: Sequence[tuple[View, _Scene, Tensor, Tensor]]) -> _Explanation:
    """How well one color for each of the positions [N, 3] explains the photos.

    Args:
        positions: world units.
        frames: of each view what it shows, what is `_near_points`, and its picture of `_still_pictures`.
    """
    count, sights = len(positions), []
    for view, scene, near, picture in frames:
        index, pixel = _pixels(positions, view, scene)
        color, still = (each.reshape(-1, 3).to(positions)[pixel] for each in (scene.color, picture))
        shown = scene.shown.flatten().to(positions.device)[pixel]
        sights.append((index, color, still, shown, shown & ~near[pixel]))
    index, color, still, shown, free = (torch.cat(each) for each in zip(*sights, strict=True))
    in_frame, shown = torch.bincount(index, minlength=count), torch.bincount(index[shown], minlength=count)
    index, color, still = index[free], color[free], still[free]
    order = order_by_point(index, color)
    index, color, still = index[order], color[order], still[order]
    sights = torch.bincount(index, minlength=count)
    middle = sights.cumsum(0) - sights + sights // 2
    median = color.new_zeros(count, 3)
    median[sights > 0] = color[middle[sights > 0]]
    residuals = torch.stack([(color - other).abs().mean(dim=-1) for other in (median[index], still)], dim=-1)
    residuals = residuals / (residuals + NOISE)
    residual, still = (summed(index, residuals, count) / sights.clamp_min(1)[:, None]).unbind(dim=-1)
    return _Explanation(median, residual, still, sights, shown, in_frame)
