"""Points of the scene far away where structure from motion found none: a sky, clouds, whatever is behind everything.

A scene starts from its points, an overlay at every pixel. Where there are no points, splats must first grow into the
frame, and meanwhile the overlay learns what they do not show: on a walk a sky hardly moves in the frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.point_samples import (
    OCCLUSION_RADIUS,
    View,
    project,
    regular_subset,
    summed,
    working_reduction,
)
from ssa_nerfstudio.evidence.statistics import FULL_SCALE

SPACING = 2.0
"""Of neighboring directions, working pixels."""
MAX_DIRECTIONS = 2**18
"""Of the whole sphere; a telephoto lens, whose pixels are smaller, has a larger spacing."""
DISTANCE = 3.0
"""Of the distant points, relative to that of the 99th percentile of the scene's points, from the cameras' mean."""
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


@torch.no_grad()
def distant_points(
    points: Tensor, views: Sequence[View], layers: Sequence[tuple[Tensor, Tensor] | None]
) -> DistantPoints:
    """Find directions in which the photos show something far away, and no point is seen.

    A direction counts if most of the views that have it in their frames see none of the scene's points around it, and
    if one color for it explains these photos at least as well as one color for each of their pixels does: what has
    parallax is not far, and what stands still in the frame is an artifact.

    Args:
        points: of the scene [P, 3], world units, finite; at least one.
        views: at least one.
        layers: of each view's artifact, T [H, W, 1 or 3] and B [H, W, 3]; None where it has none.

    Returns:
        The points, on the device of the scene's; there may be none.
    """
    every = -(-len(views) // MAX_VIEWS)
    views, layers = views[::every], layers[::every]
    poses, lenses = torch.stack([v.world_to_camera for v in views]), torch.stack([v.intrinsics for v in views])
    center = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0].mean(dim=0).to(points)
    points = regular_subset(points, len(views))
    distance = DISTANCE * float((points - center).norm(dim=1).kthvalue(math.ceil(0.99 * len(points))).values)
    reductions = [working_reduction(*view.image.shape[:2]) for view in views]
    angles = [reduction / float(lens[0, 0]) for reduction, lens in zip(reductions, lenses, strict=True)]
    angle = max(SPACING * sum(angles) / len(angles), math.sqrt(4 * math.pi / MAX_DIRECTIONS))
    sphere = center + distance * _directions(round(4 * math.pi / angle**2)).to(points)
    means = _Means()
    seen = []
    for number, (view, of_artifact) in enumerate(zip(views, layers, strict=True)):
        photo, shown = _scene_in(view, of_artifact, reductions[number])
        means.add(photo, shown)
        seen.append(_sights(sphere, points, view, photo, shown, reductions[number]))
    direction, color, free = (
        torch.cat(each) for each in zip(*((s.direction, s.color, s.free) for s in seen), strict=True)
    )
    static = torch.cat([means.of(s.size)[s.pixel] for s in seen])
    in_frames = torch.bincount(direction, minlength=len(sphere))
    direction, color, static = direction[free], color[free], static[free]
    color, direction, static = _by_direction(color, direction, static)
    sights = torch.bincount(direction, minlength=len(sphere))
    first = sights.cumsum(0) - sights
    median = color[(first + sights // 2).clamp_max(max(0, len(color) - 1))] if len(color) else sphere.new_zeros(0, 3)
    enough = (sights >= MIN_SIGHTS) & (2 * sights >= in_frames)
    if not enough.any():
        return DistantPoints(sphere[:0], sphere[:0], distance * angle)
    residuals = torch.stack([(color - other).abs().sum(dim=-1) for other in (median[direction], static)], dim=-1)
    far, still = summed(direction, residuals, len(sphere)).unbind(dim=-1)
    kept = enough & (far <= still)
    return DistantPoints(sphere[kept], median[kept], distance * angle)


@dataclass(frozen=True)
class _Sights:
    """M directions in the frame of a view."""

    direction: Tensor
    """[M] int64."""
    pixel: Tensor
    """[M] int64: working pixel, row by row."""
    color: Tensor
    """[M, 3]."""
    free: Tensor
    """[M] bool: none of the scene's points is near, and the pixel shows the scene."""
    size: tuple[int, int]
    """Height and width of the working frame."""


class _Means:
    """Mean over the photos of one size, pixel by pixel, for each size."""

    def __init__(self) -> None:
        self._sums: dict[tuple[int, int], Tensor] = {}

    def add(self, photo: Tensor, shown: Tensor) -> None:
        height, width = photo.shape[:2]
        total = torch.cat([photo * shown, shown.to(photo)], dim=-1)
        self._sums[height, width] = self._sums.get((height, width), 0) + total

    def of(self, size: tuple[int, int]) -> Tensor:
        """[h w, 3]."""
        total = self._sums[size].reshape(-1, 4)
        return total[:, :3] / total[:, 3:].clamp_min(1)


def _directions(count: int) -> Tensor:
    """Unit vectors [N, 3], evenly over all directions (a Fibonacci lattice)."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * number / count, math.pi * (1 + math.sqrt(5)) * number
    radius = (1 - height**2).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], dim=-1)


def _scene_in(view: View, layers: tuple[Tensor, Tensor] | None, reduction: int) -> tuple[Tensor, Tensor]:
    """What a photo shows of the scene, at the working resolution: color [h, w, 3], and where it shows it [h, w, 1]."""
    device = view.image.device
    photo = reduced(view.image[..., :3].float(), reduction) / FULL_SCALE.get(view.image.dtype, 1.0)
    shown = torch.ones_like(photo[..., :1], dtype=torch.bool)
    if view.mask is not None:
        height, width = view.image.shape[:2]
        shown &= reduced((view.mask.reshape(height, width, 1) != 0).to(photo), reduction) == 1
    if layers is not None:
        transmittance, addition = (reduced(layer.to(device), reduction) for layer in layers)
        transmittance = transmittance.mean(dim=-1, keepdim=True)
        shown &= transmittance >= MIN_SHOWN
        photo = ((photo - addition) / transmittance.clamp_min(MIN_SHOWN)).clamp(0, 1)
    return photo if view.gain is None else photo / view.gain.to(photo), shown


def _sights(sphere: Tensor, points: Tensor, view: View, photo: Tensor, shown: Tensor, reduction: int) -> _Sights:
    height, width = photo.shape[:2]
    camera = view.world_to_camera[None], view.intrinsics[None], height * reduction, width * reduction

    def pixels(positions: Tensor) -> tuple[Tensor, Tensor]:
        _, index, position, _ = project(positions, *camera)
        x, y = (position / reduction).long().unbind(dim=-1)
        return index, y.clamp_max(height - 1) * width + x.clamp_max(width - 1)

    taken = torch.zeros(height * width, device=sphere.device)
    taken[pixels(points)[1]] = 1
    side = 2 * OCCLUSION_RADIUS + 1
    taken = nn.functional.max_pool2d(taken.reshape(1, height, width), side, 1, OCCLUSION_RADIUS).flatten()
    direction, pixel = pixels(sphere)
    photo, shown = photo.to(sphere).reshape(-1, 3), shown.to(sphere.device).flatten()
    return _Sights(direction, pixel, photo[pixel], (taken[pixel] == 0) & shown[pixel], (height, width))


def _by_direction(color: Tensor, direction: Tensor, static: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sorted by direction, then by brightness."""
    order = torch.argsort(color.sum(dim=-1))
    order = order[torch.argsort(direction[order], stable=True)]
    return color[order], direction[order], static[order]
