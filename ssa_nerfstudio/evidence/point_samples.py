"""Samples of a scene's points in the photos: each visible point's color, again from every view that sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence import brightness
from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL

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
    """[S, 3], at least 0, about 1 at most but for a view's gain: what the photo shows of the point."""
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


def sample_points(points: Tensor, views: Sequence[View], guide: Tensor | None = None) -> PointSamples:
    """Project points into every view, drop those that nearer ones hide, and read the photo there.

    A photo is read where the point is, through a box as large as a working pixel. Read in the working pixel around it,
    up to half of that from the point, it would show something else of the scene. But layers are those of the pixel,
    and where the artifact has an edge, the box around the point has others. So a sample is brought to its pixel by
    the mean M and the deviation D of the photos, which the artifact changes to T M + B and T D: of a color I at the
    point, it is M + (I - M') D / D' with M', D' at the point.

    Args:
        points: [N, 3], world units; those that are not finite are left out.
        views: of one size, at least one.
        guide: M and D of the photos, [H, W, 4]; None: samples are left as they are read.

    Returns:
        The samples, on the points' device.
    """
    points = regular_subset(points[torch.isfinite(points).all(dim=-1)], len(views))
    height, width = views[0].image.shape[:2]
    reduction = working_reduction(height, width)
    size = height // reduction, width // reduction
    if guide is not None:
        guide = guide.to(points.device).float()
        of_pixels = reduced(guide, reduction).reshape(-1, 4)
    found = []
    for number, view in enumerate(views):
        image = view.image[..., :3].to(points.device)
        index, place, position = _visible(points, view, reduction, size)
        if view.mask is not None:
            mask = (view.mask.reshape(height, width, 1) != 0).to(points.device).float()
            seen = reduced(mask, reduction).flatten()[place] == 1
            seen &= _box_means(mask, position, reduction)[:, 0] > 1 - GRAY_LEVEL
            index, place, position = index[seen], place[seen], position[seen]
        color = _box_means(image, position, reduction) / {torch.uint8: 255.0, torch.uint16: 65535.0}.get(image.dtype, 1)
        color = color if view.gain is None else color / view.gain.to(color)
        if guide is not None:
            mean, deviation = of_pixels[place].split((3, 1), dim=-1)
            mean_there, deviation_there = _box_means(guide, position, reduction).split((3, 1), dim=-1)
            # A gray level, because photos are rounded.
            ratio = (deviation + GRAY_LEVEL) / (deviation_there + GRAY_LEVEL)
            color = (mean + (color - mean_there) * ratio).clamp_min(0)
        found.append((index, place, color, torch.full_like(index, number)))
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


def _box_means(image: Tensor, center: Tensor, side: int) -> Tensor:
    """Means [M, C] of an image [H, W, C] over boxes of this side around x, y [M, 2], which are moved into the frame.

    Between pixels by bilinear interpolation, in the image's own units.
    """
    height, width = image.shape[:2]
    most = center.new_tensor([width - side, height - side])
    corner = torch.minimum((center - side / 2).clamp_min(0), most)
    first = corner.floor()
    # The first pixel of a row counts by its part in the box, and so does the one after the last whole one.
    weights = torch.ones(*center.shape, side + 1, device=center.device)
    weights[..., -1] = corner - first
    weights[..., 0] -= weights[..., -1]
    x, y = (first.long()[..., None] + torch.arange(side + 1, device=center.device)).unbind(dim=1)
    values = image[y.clamp_max(height - 1)[:, :, None], x.clamp_max(width - 1)[:, None, :]].float()
    return torch.einsum("mijc,mj,mi->mc", values, *weights.unbind(dim=1)) / side**2


def _visible(points: Tensor, view: View, reduction: int, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of the points that the view sees, their working pixels, and their positions in the photo."""
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
    return index[seen], pixel[seen], position[seen]
