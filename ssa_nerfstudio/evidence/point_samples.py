"""Samples of a scene's points in the photos: each visible point's color, again from every view that sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence import brightness
from ssa_nerfstudio.evidence.guided_upsampling import reduced

WORKING_SIZE = brightness.WORKING_SIZE // 2
"""Photos are reduced by the integer that brings their longer side nearest to this, pixels: half of detection's."""
OCCLUSION_TOLERANCE = 0.05
"""A point is hidden where another one within OCCLUSION_RADIUS is nearer by more than this share of its depth."""
OCCLUSION_RADIUS = 2
"""Working pixels."""
MAX_PROJECTIONS = 5_000_000
"""Points times views; of more points a regular subset is projected, whose samples are dense enough."""
MIN_DEPTH = 1e-6
"""World units; points nearer to a camera's plane are behind it."""


@dataclass(frozen=True)
class View:
    """A photo with its camera."""

    image: Tensor
    """[H, W, 3 or more], uint8 or uint16 in full range, or float in [0, 1]."""
    mask: Tensor | None
    """[H, W] or [H, W, 1]: pixels that are not 0 count; None: all."""
    world_to_camera: Tensor
    """[4, 4], OpenCV's axes: x right, y down, z forward."""
    intrinsics: Tensor
    """[3, 3], pixels."""
    gain: Tensor | None = None
    """[3], per channel: colors are divided by it, which brings photos to one exposure; None: they stay as they are."""


@dataclass(frozen=True)
class PointSamples:
    """What the views show of each point. A sample is a point in a view."""

    point: Tensor
    """[S] int64: index of the point; samples are sorted by it, then by brightness."""
    pixel: Tensor
    """[S] int64: working pixel, row by row."""
    color: Tensor
    """[S, 3] in [0, 1], brighter only by a view's gain: the photo there."""
    points: int
    """Number of points."""
    size: tuple[int, int]
    """Height and width of the working frame."""
    view: Tensor
    """[S] int64: index of the view."""

    def ordered(self) -> PointSamples:
        """Sorted by point, then by brightness."""
        order = torch.argsort(self.color.sum(dim=-1))
        order = order[torch.argsort(self.point[order], stable=True)]
        point, pixel, color, view = (each[order] for each in (self.point, self.pixel, self.color, self.view))
        return PointSamples(point, pixel, color, self.points, self.size, view)


def working_reduction(height: int, width: int) -> int:
    """The integer by which photos of this size are reduced."""
    return max(1, min(round(max(height, width) / WORKING_SIZE), height, width))


def sample_points(points: Tensor, views: Sequence[View]) -> PointSamples:
    """Project points into every view, drop those that nearer ones hide, and read the photo there.

    Args:
        points: [N, 3], world units; those that are not finite are left out.
        views: of one size, at least one.

    Returns:
        The samples, on the points' device.
    """
    points = regular_subset(points[torch.isfinite(points).all(dim=-1)], len(views))
    height, width = views[0].image.shape[:2]
    reduction = working_reduction(height, width)
    size = height // reduction, width // reduction
    found = []
    for number, view in enumerate(views):
        image = _reduced(view.image[..., :3], reduction, points.device)
        image = image if view.gain is None else image / view.gain.to(image)
        index, place = _visible(points, view, reduction, size)
        if view.mask is not None:
            seen = _reduced(view.mask.reshape(height, width, 1) != 0, reduction, points.device)[..., 0] == 1
            kept = seen.flatten()[place]
            index, place = index[kept], place[kept]
        found.append((index, place, image.reshape(-1, 3)[place], torch.full_like(index, number)))
    point, pixel, color, shown_by = (torch.cat(parts) for parts in zip(*found, strict=True))
    return PointSamples(point, pixel, color, len(points), size, shown_by).ordered()


def regular_subset(points: Tensor, views: int) -> Tensor:
    """Every n-th of points [N, 3], so that points times views are at most MAX_PROJECTIONS."""
    return points[:: max(1, -(-len(points) * views // MAX_PROJECTIONS))]


def summed(index: Tensor, values: Tensor, count: int) -> Tensor:
    """Sums [count, C] of values [S, C] with equal indices in [0, count)."""
    return values.new_zeros(count, values.shape[1]).index_add_(0, index, values)


def project(
    points: Tensor, world_to_camera: Tensor, intrinsics: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Project points into a camera's frame.

    Args:
        points: [N, 3], world units.
        world_to_camera: [4, 4], OpenCV's axes.
        intrinsics: [3, 3], pixels.
        height, width: of the frame, pixels.

    Returns:
        Of the M points in the frame: their indices [M], positions x, y [M, 2] in pixels, and depths [M].
    """
    pose = world_to_camera.to(points)
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = camera[:, 2]
    position = (camera @ intrinsics.to(points).T)[:, :2] / depth[:, None].clamp_min(MIN_DEPTH)
    x, y = position.unbind(dim=-1)
    index = ((depth > MIN_DEPTH) & (x >= 0) & (x < width) & (y >= 0) & (y < height)).nonzero()[:, 0]
    return index, position[index], depth[index]


def _reduced(image: Tensor, reduction: int, device: torch.device) -> Tensor:
    """At the working size [h, w, C], float32 in [0, 1]."""
    full = {torch.uint8: 255.0, torch.uint16: 65535.0}.get(image.dtype, 1.0)
    return reduced(image.to(device).float(), reduction) / full


def _visible(points: Tensor, view: View, reduction: int, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Indices of the points that the view sees, and their working pixels."""
    height, width = size
    index, position, depth = project(
        points, view.world_to_camera, view.intrinsics, height * reduction, width * reduction
    )
    x, y = (position / reduction).long().unbind(dim=-1)
    pixel = y * width + x
    nearest = torch.full((height * width,), torch.inf, device=points.device, dtype=depth.dtype)
    nearest = nearest.scatter_reduce(0, pixel, depth, "amin").reshape(1, 1, height, width)
    side = 2 * OCCLUSION_RADIUS + 1
    nearest = -nn.functional.max_pool2d(-nearest, side, stride=1, padding=OCCLUSION_RADIUS)
    seen = depth <= nearest.flatten()[pixel] * (1 + OCCLUSION_TOLERANCE)
    return index[seen], pixel[seen]
