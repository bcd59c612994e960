"""Points of the scene far away where structure from motion found none: a sky, clouds, distant hills.

A scene starts from its points, an overlay at every pixel. Where there are no points, splats must first grow into the
frame, and meanwhile the overlay learns what they do not show: on a walk a sky hardly moves in the frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.special import stdtrit
from torch import Tensor

from ssa_nerfstudio.evidence.nearest_depths import OCCLUSION_RADIUS
from ssa_nerfstudio.evidence.point_samples import order_by_point, regular_subset, summed
from ssa_nerfstudio.evidence.scene_photos import ScenePhoto, near_points, projections
from ssa_nerfstudio.evidence.seeds import Seeds

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
PATCH = 30
"""Directions that are left out together, because one alone says little."""
SIGNIFICANCE = 0.001
"""Probability that chance alone leaves a patch out, or takes an area for distant."""
NEIGHBORHOOD = 1.5
"""Distance up to which directions are connected, relative to their spacing."""
MIN_SIGHTS = 3
"""Views that must see a direction: the fewest of which a median leaves one out."""


_Place = TypeVar("_Place", int, Tensor)


@torch.no_grad()
def distant_points(points: Tensor, photos: Sequence[ScenePhoto], sphere: Sphere) -> Seeds:
    """Find directions in which the photos show something far away, and no point is seen.

    A direction is a candidate if half of the views that show it see none of the scene's points around it. If it is far
    away, two views agree on its color. Alternatives are that they agree at a pixel, because an artifact stands still in
    the frame, or at a distance at which the scene has its points, because what is nearer has parallax. Costs are
    compared view by view: patches that an alternative explains better, by a one-sided t-test over the views, are left
    out, and a connected area of the others is far away if that explains it better than each of the nearer distances, by
    the same test, and it does not stand still. Where cameras are too close together for any parallax, nothing speaks
    against it. Costs are robust, because something nearer may hide a direction from some of the views.

    Args:
        points: of the scene [P, 3], world units, finite; at least one.
        photos: at least one.
        sphere: where they are, `horizon`.

    Returns:
        The seeds, on the device of the scene's points; there may be none.
    """
    points = regular_subset(points, len(photos))
    center, radius = sphere.center, sphere.radius
    baseline = float((_cameras(photos).to(points) - center).norm(dim=1).max())
    nearer = [_distance(points, center, share) for share in NEARER]
    angles = [photo.reduction / float(photo.view.intrinsics[0, 0]) for photo in photos]
    angle = max(SPACING * sum(angles) / len(angles), math.sqrt(4 * math.pi / MAX_DIRECTIONS))
    directions = _directions(round(4 * math.pi / angle**2)).to(points)
    near, pictures = near_points(points, photos, OCCLUSION_RADIUS), _still_pictures(photos)
    far = _sights(center + radius * directions, photos, near, pictures)
    likely = (far.counted >= MIN_SIGHTS) & (2 * far.counted >= far.shown)
    candidates = likely.nonzero()[:, 0]
    if not len(candidates):
        return Seeds.none(points)
    nearer = [at for at in nearer if at > 0 and baseline * (1 / at - 1 / radius) > angle]
    cost, still = far.cost()[candidates], far.still_cost()[candidates]
    alternatives = [_sights(center + at * directions[candidates], photos, near, pictures).cost() for at in nearer]
    distant = _distant(directions[candidates], angle, cost - still, [cost - other for other in alternatives])
    found = candidates[distant]
    positions = center + radius * directions[found]
    return Seeds(positions, far.median()[found], positions.new_full((len(positions),), radius * angle))


@dataclass(frozen=True)
class Sphere:
    """Where distant points are."""

    center: Tensor
    """[3], mean of the cameras."""
    radius: float
    """World units."""

    def depths(self, camera: Tensor, rays: Tensor) -> Tensor:
        """Multiples [N] of rays [N, 3] by which they leave the sphere, from a camera [3] inside."""
        offset, squares = camera - self.center, rays.square().sum(dim=-1)
        along = rays @ offset / squares
        # Of a scene of almost no points cameras may be outside.
        radius = max(self.radius, 2 * float(offset.norm()))
        inside = radius**2 - offset.square().sum()
        return (along.square() + inside / squares).sqrt() - along


def horizon(points: Tensor, photos: Sequence[ScenePhoto]) -> Sphere:
    """The sphere beyond all but a few points of the scene [P, 3]."""
    center = _cameras(photos).to(points).mean(dim=0)
    return Sphere(center, DISTANCE * _distance(points, center, NEARER[-1]))


def _cameras(photos: Sequence[ScenePhoto]) -> Tensor:
    """Positions [V, 3]."""
    return torch.stack([photo.view.position for photo in photos])


def _distance(points: Tensor, center: Tensor, share: float) -> float:
    """Of this share of the points the largest distance from a center."""
    return float((points - center).norm(dim=1).kthvalue(math.ceil(share * len(points))).values)


@dataclass(frozen=True)
class _Sights:
    """What V views show of N positions: M pairs of a position and a view that counts, position by position.

    A view does not count where the position is not in the frame, hidden, or near one of the scene's points.
    """

    index: Tensor
    """[M] int64: of the position."""
    view: Tensor
    """[M] int64, ascending for each position."""
    color: Tensor
    """[M, 3]."""
    still: Tensor
    """[M, 3]: another view's color at the same pixel; NaN where that shows nothing."""
    counted: Tensor
    """[N] int64: views that count."""
    shown: Tensor
    """[N] int64: views that show a position, near points or not."""
    views: int
    """V."""

    def cost(self) -> Tensor:
        """[N, V], of the color there in another view; NaN for all views if fewer than MIN_SIGHTS count.

        Of n views the other one is n / 3 further, so that each is compared with two. The median of all would be less
        noisy the more there are, and of two distances the one that is in more frames would seem better.
        """
        place = torch.arange(len(self.index), device=self.index.device) - self._first()[self.index]
        other = self._first()[self.index] + _another(place, self.counted[self.index])
        cost = self._cost_beside(self.color[other])
        cost[self.counted < MIN_SIGHTS] = torch.nan
        return cost

    def still_cost(self) -> Tensor:
        """[N, V], of what stands still in the frame; NaN also where the other view shows nothing."""
        return self._cost_beside(self.still)

    def median(self) -> Tensor:
        """Of the colors that count, the one of median brightness, [N, 3]; black where none does."""
        median, any_counts = self.color.new_zeros(len(self.counted), 3), self.counted > 0
        middle = (self._first() + self.counted // 2)[any_counts]
        median[any_counts] = self.color[order_by_point(self.index, self.color)][middle]
        return median

    def _first(self) -> Tensor:
        """[N]: where each position's pairs begin."""
        return self.counted.cumsum(0) - self.counted

    def _cost_beside(self, reference: Tensor) -> Tensor:
        """[N, V]: a difference d from colors [M, 3] costs d / (d + NOISE); NaN where a view does not count."""
        cost = self.color.new_full((len(self.counted), self.views), torch.nan)
        difference = (self.color - reference).abs().mean(dim=-1)
        cost[self.index, self.view] = difference / (difference + NOISE)
        return cost


def _distant(directions: Tensor, angle: float, beside_still: Tensor, beside_nearer: Sequence[Tensor]) -> Tensor:
    """Whether directions belong to an area that is far away, bool [N].

    Args:
        directions: [N, 3].
        angle: between neighbors, radians.
        beside_still: cost of each direction far away in each view, less that where it stands still in the frame [N, V];
            NaN where they cannot be compared.
        beside_nearer: less that at each of the nearer distances, likewise.
    """
    differences = beside_still, *beside_nearer
    patches = _directions(round(4 * math.pi / (PATCH * angle**2)))
    _, patch = KDTree(patches.numpy()).query(directions.cpu().numpy())
    patch = torch.from_numpy(np.asarray(patch, dtype=np.int64)).to(directions.device)
    excluded = torch.zeros_like(directions[:, 0], dtype=torch.bool)
    for difference in differences:
        excluded |= (_significance(patch, difference, len(patches)) > 1)[patch]
    rest = (~excluded).nonzero()[:, 0]
    area = _connected(directions[rest], NEIGHBORHOOD * angle)
    still, *nearer = (_significance(area, difference[rest], len(rest)) for difference in differences)
    accepted = still <= 1
    for value in nearer:
        accepted &= value < -1
    distant = torch.zeros_like(excluded)
    distant[rest] = accepted[area]
    return distant


def _significance(part: Tensor, differences: Tensor, count: int) -> Tensor:
    """Mean difference of each part, relative to what chance exceeds with a probability of SIGNIFICANCE, [count].

    The unit of the t-test is a view, because what one view shows is not independent. 0 where fewer than MIN_SIGHTS
    views can be compared.

    Args:
        part: number of the part that a direction belongs to, [N].
        differences: of each direction in each view [N, V]; NaN where there is none.
        count: of the parts.
    """
    totals = summed(part, differences.nan_to_num(), count)
    counts = summed(part, differences.isfinite().to(differences), count)
    views = (counts > 0).sum(dim=1)
    sums = totals.sum(dim=1)
    means = sums / counts.sum(dim=1).clamp_min(1)
    spread = (totals - counts * means[:, None]).square().sum(dim=1)
    error = (spread * views / (views - 1).clamp_min(1)).sqrt()
    quantiles = stdtrit(np.arange(1, max(counts.shape[1], 2)), 1 - SIGNIFICANCE)
    least = error * torch.from_numpy(quantiles).to(error)[(views - 2).clamp_min(0)]
    return torch.where(views >= MIN_SIGHTS, sums / least.clamp_min(torch.finfo(least.dtype).tiny), 0)


def _directions(count: int) -> Tensor:
    """Unit vectors [N, 3], evenly over all directions (a Fibonacci lattice)."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * number / count, math.pi * (1 + math.sqrt(5)) * number
    radius = (1 - height**2).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], dim=-1)


def _connected(directions: Tensor, angle: float) -> Tensor:
    """Number of the connected area of each direction [N], of neighbors within an angle (radians)."""
    if not len(directions):
        return torch.zeros(0, dtype=torch.int64, device=directions.device)
    pairs = KDTree(directions.cpu().numpy()).query_pairs(angle, output_type="ndarray")
    linked = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=2 * (len(directions),))
    return torch.from_numpy(connected_components(linked, directed=False)[1].astype(np.int64)).to(directions.device)


def _still_pictures(photos: Sequence[ScenePhoto]) -> list[Tensor]:
    """For each photo another of its group and size, a third of them further, [h, w, 3]; NaN where it shows nothing."""
    alike: dict[tuple[int, tuple[int, int]], list[int]] = {}
    for number, photo in enumerate(photos):
        alike.setdefault((photo.group, photo.size), []).append(number)
    pictures = [torch.where(photo.shown, photo.color, torch.nan) for photo in photos]
    others = [torch.full_like(picture, torch.nan) for picture in pictures]
    for members in alike.values():
        if len(members) >= MIN_SIGHTS:
            for place, number in enumerate(members):
                others[number] = pictures[members[_another(place, len(members))]]
    return others


def _another(place: _Place, count: _Place) -> _Place:
    """Which of at least three a view is compared with, given the place of its own; each is with two different ones."""
    return (place + count // 3) % count


def _sights(
    positions: Tensor, photos: Sequence[ScenePhoto], near: Sequence[Tensor], pictures: Sequence[Tensor]
) -> _Sights:
    """What photos show of positions [N, 3].

    Args:
        positions: world units.
        photos: at least one.
        near: where each is `near_points`.
        pictures: of each, `_still_pictures`.
    """
    count, sights = len(positions), []
    colors, masks = [photo.color for photo in photos], [photo.shown for photo in photos]
    for seen in projections(positions, photos):
        color, still = (seen.read(each).to(positions) for each in (colors, pictures))
        shown = seen.read(masks)[:, 0]
        sights.append((seen.index, seen.view + seen.first, color, still, shown, shown & ~seen.read(near)[:, 0]))
    index, view, color, still, shown, counts = (torch.cat(each) for each in zip(*sights, strict=True))
    shown = torch.bincount(index[shown], minlength=count)
    counts = counts.nonzero()[:, 0]
    in_views = counts[torch.argsort(index[counts], stable=True)]
    index, view, color, still = index[in_views], view[in_views], color[in_views], still[in_views]
    counted = torch.bincount(index, minlength=count)
    return _Sights(index, view, color, still, counted, shown, len(photos))
