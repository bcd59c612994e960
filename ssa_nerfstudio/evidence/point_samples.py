"""Samples of a scene's points in the photos: each visible point's color, again from every view that sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import Tensor

from ssa_nerfstudio.evidence import brightness
from ssa_nerfstudio.evidence.box_means import box_means, patch_means, read_boxes
from ssa_nerfstudio.evidence.nearest_depths import OCCLUSION_RADIUS, nearest_depths
from ssa_nerfstudio.evidence.statistics import FULL_SCALE, GRAY_LEVEL, UNKNOWN_DEVIATION

WORKING_SIZE = brightness.WORKING_SIZE // 2
"""Photos are reduced by the integer that brings their longer side nearest to this, pixels: half of detection's."""
OCCLUSION_TOLERANCE = 0.05
"""A point is hidden where another one within OCCLUSION_RADIUS is nearer by more than this share of its depth."""
MAX_PROJECTIONS = 5_000_000
"""Points times views; of more points a regular subset is projected, whose samples are dense enough."""
VIEWS_AT_ONCE = 64
"""Views whose points are compared by depth together; a larger number only costs memory."""
VALUES_AT_ONCE = 2**24
"""Values of photos that are worked on together on a GPU, which waits for its host. A CPU's cache is for one photo."""
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

    @property
    def position(self) -> Tensor:
        """Of the camera, [3], world units."""
        return -self.world_to_camera[:3, 3] @ self.world_to_camera[:3, :3]


@dataclass(frozen=True)
class PointSamples:
    """What the views show of each point. A sample is a point in a view."""

    point: Tensor
    """[S] int64: index of the point; samples are sorted by it, then by brightness."""
    pixel: Tensor
    """[S] int64: working pixel, row by row."""
    color: Tensor
    """[S, 3] in [0, 1], brighter only by a view's gain: what the photo shows of the point."""
    points: int
    """Number of points."""
    size: tuple[int, int]
    """Height and width of the working frame."""
    view: Tensor
    """[S] int64: index of the view."""
    patch: Tensor | None = None
    """[S, 3]: mean color around the point, over a footprint of constant size in the scene, NaN where all of it is known
    to be opaque; None: not read."""
    focal_ratio: float = 1.0
    """Mean focal length of the views along x by that along y, both in pixels: a circle around the lens's axis is this
    many times as wide as it is high."""

    def ordered(self) -> PointSamples:
        """Sorted by point, then by brightness."""
        order = order_by_point(self.point, self.color)
        point, pixel, color, view = (each[order] for each in (self.point, self.pixel, self.color, self.view))
        patch = None if self.patch is None else self.patch[order]
        return replace(self, point=point, pixel=pixel, color=color, view=view, patch=patch)


@dataclass(frozen=True)
class Sights:
    """M pairs of a view and a point that it sees, view by view."""

    view: Tensor
    """[M] int64: index of the view."""
    point: Tensor
    """[M] int64: index of the point."""
    pixel: Tensor
    """[M] int64: working pixel, row by row."""
    position: Tensor
    """[M, 2]: x and y in the photo."""
    depth: Tensor
    """[M]."""


def working_reduction(height: int, width: int) -> int:
    """The integer by which photos of this size are reduced."""
    return max(1, min(round(max(height, width) / WORKING_SIZE), height, width))


def sample_points(
    points: Tensor, views: Sequence[View], guide: Tensor | None = None, opaque: Tensor | None = None
) -> PointSamples:
    """Project points into every view, drop those that nearer ones hide, and read the photo there.

    A photo is read where the point is, through a box as large as a working pixel. Read in the working pixel around it,
    up to half of that from the point, it would show something else of the scene. But layers are those of the pixel,
    and where the artifact has an edge, the box around the point has others. So a sample is brought to its pixel by
    matching mean and deviation: with the mean M and the deviation D of the photos in the pixel, and M', D' in the box
    around the point, a color I' is M + (I' - M') D / D' in the pixel, because in front of the same scene an artifact
    changes M to T M + B and D to T D.

    The nearer a point, the smaller the part of the scene that a box covers. So the color of a point changes with its
    distance, and on a walk with its place in the frame. `patch` is the mean over a footprint whose width in the frame
    is inversely proportional to depth: that of the window of occlusions where the point is farthest.

    Args:
        points: [N, 3], world units; those that are not finite are left out.
        views: of one size, at least one.
        guide: M and D of the photos, [H, W, 4], see `initialization.guide_of`; where D is unknown, and without a guide,
            samples are left as they are read. Without one, patches are not read.
        opaque: [H, W] bool, pixels that show nothing of the scene (`Detection.opaque`): patches leave out what holds
            any; None: there are none.

    Returns:
        The samples, on the points' device.
    """
    points = regular_subset(points[torch.isfinite(points).all(dim=-1)], len(views))
    height, width = views[0].image.shape[:2]
    reduction = working_reduction(height, width)
    size = height // reduction, width // reduction
    if guide is not None:
        guide = guide.to(points.device)
        unknown = guide[..., 3:] == UNKNOWN_DEVIATION
        guide = box_means(torch.cat([guide, unknown], dim=-1), reduction)
        of_pixels = guide[::reduction, ::reduction].reshape(-1, 5)
    clear = None
    if opaque is not None and opaque.any():
        clear = (box_means(opaque.to(points.device)[..., None], reduction)[::reduction, ::reduction] == 0).float()
    seen = visible(points, views, reduction, size)
    farthest = seen.depth.new_zeros(len(points)).scatter_reduce(0, seen.point, seen.depth, "amax")
    footprint = (2 * OCCLUSION_RADIUS + 1) * farthest[seen.point] / seen.depth
    counts = torch.bincount(seen.view, minlength=len(views)).tolist()
    colors, patches, kept, at_once = [], [], [], photos_at_once(points.device, 3 * height * width)
    ends = [0, *accumulate(counts)]
    for first in range(0, len(views), at_once):
        some = views[first : first + at_once]
        own = slice(ends[first], ends[first + len(some)])
        view, pixel, position, side = seen.view[own] - first, seen.pixel[own], seen.position[own], footprint[own]
        images = torch.stack([each.image[..., :3].to(points.device).float() for each in some])
        unmasked, inside = None, torch.ones_like(pixel, dtype=torch.bool)
        if any(each.mask is not None for each in some):
            everywhere = torch.ones(height, width)
            masks = [everywhere if each.mask is None else each.mask.reshape(height, width) != 0 for each in some]
            shown = torch.stack([mask.to(points.device, torch.bool) for mask in masks])[..., None]
            images, unmasked = torch.where(shown, images, 0), box_means(shown, reduction)
            inside = unmasked[:, ::reduction, ::reduction].reshape(len(some), -1)[view, pixel] == 1
            inside &= read_boxes(unmasked, view, position, reduction)[:, 0] > 1 - GRAY_LEVEL
        kept.append(inside)
        boxes = box_means(images, reduction)
        colors.append(read_boxes(boxes, view, position, reduction))
        if guide is not None:
            weighed = unmasked is not None or clear is not None
            weight = torch.ones_like(boxes[..., :1]) if unmasked is None else unmasked
            boxes = (torch.cat([boxes, weight], dim=-1) if weighed else boxes)[:, ::reduction, ::reduction]
            patch = patch_means(boxes if clear is None else boxes * clear, view, pixel, side)
            # Sums are exact only within rounding.
            patches.append(patch[:, :3] / patch[:, 3:].where(patch[:, 3:] > 1e-6, torch.nan) if weighed else patch)
    same = torch.ones(3, device=points.device)
    gains = torch.stack([same if view.gain is None else view.gain.to(same) for view in views])
    white = gains * gains.new_tensor([[FULL_SCALE.get(view.image.dtype, 1.0)] for view in views])
    color, patch = torch.cat(colors) / white[seen.view], None
    if guide is not None:
        here = of_pixels[seen.pixel]
        there = read_boxes(guide[None], torch.zeros_like(seen.view), seen.position, reduction)
        color = torch.where(here[:, 4:] + there[:, 4:] > 0, color, _matched(color, here, there))
        color = color.clamp_min(0).minimum(1 / gains[seen.view])
        patch = torch.cat(patches) / white[seen.view]
    shown = torch.cat(kept).nonzero()[:, 0]
    point, pixel, color, shown_by = (each[shown] for each in (seen.point, seen.pixel, color, seen.view))
    patch = None if patch is None else patch[shown]
    focal_lengths = torch.stack([view.intrinsics.diagonal()[:2] for view in views]).mean(dim=0)
    ratio = float(focal_lengths[0] / focal_lengths[1])
    return PointSamples(point, pixel, color, len(points), size, shown_by, patch, ratio).ordered()


def photos_at_once(device: torch.device, values: int) -> int:
    """Number of photos, with so many values each, that are worked on together."""
    return max(1, VALUES_AT_ONCE // max(1, values)) if device.type == "cuda" else 1


def regular_subset(points: Tensor, views: int) -> Tensor:
    """Every n-th of points [N, 3], so that points times views are at most MAX_PROJECTIONS."""
    return points[:: max(1, -(-len(points) * views // MAX_PROJECTIONS))]


def summed(index: Tensor, values: Tensor, count: int) -> Tensor:
    """Sums [count, C] of values [S, C] with equal indices in [0, count)."""
    return values.new_zeros(count, values.shape[1]).index_add_(0, index, values)


def project(
    points: Tensor, world_to_camera: Tensor, intrinsics: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project points into the frames of cameras.

    Args:
        points: [N, 3], world units.
        world_to_camera: [V, 4, 4], OpenCV's axes.
        intrinsics: [V, 3, 3], pixels.
        height, width: of the frames, pixels.

    Returns:
        Of the M pairs of a camera and a point in its frame, camera by camera: indices of the camera and of the point
        [M], positions x, y [M, 2] in pixels, and depths [M].
    """
    poses, lenses = world_to_camera.to(points), intrinsics.to(points)
    in_camera = points @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    depth = in_camera[..., 2]
    position = (in_camera @ lenses.mT)[..., :2] / depth[..., None].clamp_min(MIN_DEPTH)
    x, y = position.unbind(dim=-1)
    inside = (depth > MIN_DEPTH) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    camera, point = inside.nonzero(as_tuple=True)
    return camera, point, position[camera, point], depth[camera, point]


def working_pixels(position: Tensor, size: tuple[int, int], reduction: int) -> Tensor:
    """Working pixels [M], row by row, of x and y [M, 2] in photo pixels; size: height, width of the working frame."""
    height, width = size
    x, y = (position / reduction).long().unbind(dim=-1)
    # A GPU multiplies by 1 / reduction, rounded, which may bring a position to the frame's edge.
    return y.clamp_max(height - 1) * width + x.clamp_max(width - 1)


def order_by_point(point: Tensor, color: Tensor) -> Tensor:
    """Order of samples of points [S], of these colors [S, 3]: by point, then by brightness."""
    order = torch.argsort(color.sum(dim=-1))
    return order[torch.argsort(point[order], stable=True)]


def _matched(color: Tensor, here: Tensor, there: Tensor) -> Tensor:
    """Colors [M, 3] with mean and deviation [M, 4 or more] from there brought to those here."""
    # A gray level, because photos are rounded.
    ratio = (here[:, 3:4] + GRAY_LEVEL) / (there[:, 3:4] + GRAY_LEVEL)
    return here[:, :3] + (color - there[:, :3]) * ratio


def visible(points: Tensor, views: Sequence[View], reduction: int, size: tuple[int, int]) -> Sights:
    """The points that views see: those that no nearer one within OCCLUSION_RADIUS hides.

    Args:
        points: [N, 3], world units.
        views: of one size.
        reduction: photo pixels a working pixel.
        size: height and width of the working frame.
    """
    height, width = size
    found = []
    for first in range(0, len(views), VIEWS_AT_ONCE):
        some = views[first : first + VIEWS_AT_ONCE]
        poses, lenses = torch.stack([v.world_to_camera for v in some]), torch.stack([v.intrinsics for v in some])
        view, point, position, depth = project(points, poses, lenses, height * reduction, width * reduction)
        pixel = working_pixels(position, size, reduction)
        nearest = nearest_depths(view, pixel, depth, (len(some), height, width))
        seen = (depth <= nearest[view, pixel] * (1 + OCCLUSION_TOLERANCE)).nonzero()[:, 0]
        found.append([each[seen] for each in (view + first, point, pixel, position, depth)])
    return Sights(*(torch.cat(each) for each in zip(*found, strict=True)))
