"""Change points: where, in the order of a capture, a static artifact appears, vanishes or is replaced by another.

A scan statistic over all intervals of the views, on the blocks of brightness that detection has: the edges that stand
still within an interval and are missing outside of it, or the reverse. Its null distribution comes from the capture
itself, with its blocks shifted at random. docs/detect.md derives it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np
import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.detection import DRAWS, MIN_VIEWS
from ssa_nerfstudio.evidence.displacement import displaced_share
from ssa_nerfstudio.evidence.edge_evidence import (
    COARSE_FACTOR,
    DISPLACEMENT_WINDOWS,
    EVIDENCE_THRESHOLDS,
    MAX_DISPLACED_SHARES,
    MIN_EDGE_SHARES,
    MIN_GRADIENT,
    block_images,
    gradient_moments,
)
from ssa_nerfstudio.evidence.null_distribution import MAX_SHIFT, SIGNIFICANCE, VALUES_AT_ONCE
from ssa_nerfstudio.evidence.statistics import ImageStatistics

MIN_CHANGED_SHARE = 2 * MIN_EDGE_SHARES[0]
"""Share of the frame in edges that an interval has and the rest lacks, below which nothing is reported: twice
detection's, because the scan takes the largest of some hundred."""
MIN_INTERVAL_SHARE = 1 / 8
"""Shortest interval relative to the capture; it also has at least MIN_VIEWS."""
POSITIONS = 16
"""Steps in which the scan moves the ends of an interval; what it finds is located to the view afterwards."""
CANDIDATES = 3
"""Intervals of a scan that are tested for motion, those with most edges first."""
MAX_CONTRAST = 0.5
"""Gradient per pixel that a change of the scene's mean brightness may cause at an artifact's edge, relative to that
change: what is one pixel wide, and opaque, has a central difference of a half."""
CONTRAST_RADIUS = 3
"""Working pixels around an edge in which the scene's brightness, and what else stands still, is compared."""
MIN_MOTION = 0.15
"""From block to block, gradients within an interval change at least by this share of the squares outside of it; else
the camera rests there, and all stands still. Five captures have at least 0.32, photos of one place at most 0.07."""
_ERROR_FLOOR = (MIN_GRADIENT / EVIDENCE_THRESHOLDS[0]) ** 2


def change_points(statistics: ImageStatistics, draws: int = DRAWS, seed: int = 0) -> list[int]:
    """Find where the artifact of a capture changes.

    Args:
        statistics: of all views of one camera, in the order of the capture.
        draws: shifted captures in the null distribution.
        seed: of the shifts; global random state is neither used nor changed.

    Returns:
        The number of the first view of every interval but the first one, ascending; empty where nothing changes.
    """
    if statistics.brightness.views < 2 * MIN_VIEWS:
        return []
    scan = _Scan(statistics, draws, np.random.default_rng(seed))
    ends = scan.settled([0, *scan.split(0, len(statistics.brightness)), len(statistics.brightness)])
    return [scan.located(*ends[k : k + 3]) for k in range(len(ends) - 2)]


class _Scan:
    """Scans stretches of a capture; ends are numbers of blocks."""

    def __init__(self, statistics: ImageStatistics, draws: int, rng: np.random.Generator) -> None:
        self._statistics, self._draws, self._rng = statistics, draws, rng
        blocks = statistics.brightness
        views = max(MIN_VIEWS, MIN_INTERVAL_SHARE * blocks.views)
        self._shortest = int(np.ceil(views / blocks.views_per_block))
        # Half of the pixels along each axis are enough to find what is then tested on all.
        self._blocks = torch.stack([self._part([block])[1][0, :, ::2, ::2] for block in range(len(blocks))])

    def split(self, first: int, last: int) -> list[int]:
        """Ends of intervals within a stretch, ascending."""
        found = self._largest_change(first, last)
        if found is None:
            return []
        ends = [first, *(end for end in found if first < end < last), last]
        within = [self.split(start, end) for start, end in pairwise(ends)]
        return sorted([*ends[1:-1], *(end for part in within for end in part)])

    def settled(self, ends: list[int]) -> list[int]:
        """The ends without those that separate intervals which do not differ: what is left beside another change."""
        kept = 1
        while len(ends) > 3 and kept < len(ends) - 1:
            before, end, after = ends[kept - 1 : kept + 2]
            if self._differs(before, end, before, after):
                kept += 1
            else:
                del ends[kept]
        return ends

    def located(self, first: int, cut: int, last: int) -> int:
        """The view at which one interval ends and the next begins.

        Along the difference of the two mean gradients each block lies between 0 (the later) and 1 (the earlier); of the
        one that holds the change, this is the share of its views that come before.
        """
        before, after = (self._part(range(*ends)) for ends in ((first, cut), (cut, last)))
        earlier, later = (moments[:, :2].mean(dim=0) for _, moments in (before, after))
        sums = _summed(before[1]), _summed(after[1])
        place = _only_in(*sums[0], *sums[1]) | _only_in(*sums[1], *sums[0])
        difference = (earlier - later)[:, place]
        shares = []
        for block in range(first, last):
            gradient = self._part([block])[1][0, :2]
            along = ((gradient - later)[:, place] * difference).sum() / difference.square().sum().clamp_min(1e-12)
            shares.append(float(along.clamp(0, 1)))
        gain = np.cumsum(np.array(shares) - 0.5)
        end = int(np.argmax(gain[:-1]))  # the last block that is more of the earlier interval
        size = self._statistics.brightness.views_per_block
        return (first + end) * size + max(1, round(size * (shares[end] + shares[end + 1])))

    def _largest_change(self, first: int, last: int) -> tuple[int, int] | None:
        """Ends of the interval of a stretch that differs most from its rest; None where none differs enough."""
        step = max(1, -(-(last - first) // POSITIONS))
        positions = [*range(first, last - step // 2, step), last]
        chosen = [ends for ends in combinations(positions, 2) if self._testable(*ends, first, last)]
        if not chosen:
            return None
        moments = self._blocks[first:last]
        intervals = [(start - first, end - first) for start, end in chosen]
        shares = _changed_shares(moments, intervals)
        for index in np.argsort(-shares)[:CANDIDATES]:
            if shares[index] < MIN_CHANGED_SHARE:
                return None
            start, end = chosen[index]
            if self._differs(start, end, first, last):
                return (start, end) if self._significant(moments[..., ::2, ::2], intervals) else None
        return None

    def _testable(self, start: int, end: int, first: int, last: int) -> bool:
        """Whether an interval and what is left before and after it are long enough.

        One at the end of the stretch is the rest of one at its beginning.
        """
        before, after = start - first, last - end
        parts = [length for length in (before, after) if length]
        return bool(after) and min(end - start, *parts) >= self._shortest

    def _differs(self, start: int, end: int, first: int, last: int) -> bool:
        """Test one interval against the rest of its stretch at full working resolution.

        Edges do not count where the scene moves, where a change of its brightness explains them, where the camera
        rests, and where most of what stands still around them stays: a video's keyframe encodes fine grain anew.
        """
        within, rest = [*range(start, end)], [*range(first, start), *range(end, last)]
        inside, outside = self._part(within), self._part(rest)
        contrast = (inside[0].mean(dim=0) - outside[0].mean(dim=0)).abs()[None, None]
        side = 2 * CONTRAST_RADIUS + 1
        contrast = -nn.functional.max_pool2d(-contrast, side, stride=1, padding=CONTRAST_RADIUS)[0, 0]
        change = (inside[1][:, :2].mean(dim=0) - outside[1][:, :2].mean(dim=0)).norm(dim=0)
        motion = self._motion(within) / max(self._motion(rest), _ERROR_FLOOR)
        for part, other, enough in (
            (inside, outside, motion >= MIN_MOTION),
            (outside, inside, motion <= 1 / MIN_MOTION),
        ):
            images, moments = part
            sums, missing = _summed(moments), _summed(other[1])
            edges = _only_in(*sums, *missing) & _mostly_missing(*sums, *missing) & (change > MAX_CONTRAST * contrast)
            if not enough or edges.float().mean() < MIN_CHANGED_SHARE:
                continue
            moved = displaced_share(images, moments[:, :2].mean(dim=0), DISPLACEMENT_WINDOWS[0])
            if (edges & (moved <= MAX_DISPLACED_SHARES[0])).float().mean() >= MIN_CHANGED_SHARE:
                return True
        return False

    def _motion(self, blocks: list[int]) -> float:
        """Squared change of the gradient from block to block: median over blocks, upper quartile over pixels."""
        steps = self._blocks[blocks, :2].diff(dim=0).square().sum(dim=1)
        return float(np.quantile(steps.median(dim=0).values.cpu().numpy(), 0.75))

    def _significant(self, moments: Tensor, intervals: list[tuple[int, int]]) -> bool:
        """Whether at most SIGNIFICANCE of the shifted stretches have an interval that differs as much.

        Args:
            moments: of the stretch's blocks at every COARSE_FACTOR-th working pixel, the step of the shifts.
            intervals: see `_changed_shares`.
        """
        observed, reach = _changed_shares(moments, intervals).max(), MAX_SHIFT // COARSE_FACTOR
        exceeding = 0
        for _ in range(self._draws):
            shifts = self._rng.integers(-reach, reach + 1, (len(moments), 2)).tolist()
            shifted = [torch.roll(block, shift, (1, 2)) for block, shift in zip(moments, shifts, strict=True)]
            exceeding += bool(_changed_shares(torch.stack(shifted), intervals).max() >= observed)
            if 1 + exceeding > SIGNIFICANCE * (1 + self._draws):
                return False
        return True

    def _part(self, blocks: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Images [K, h, w] and `gradient_moments` of blocks, joined as for detection."""
        images, hidden = block_images(self._statistics, blocks)
        return images, gradient_moments(images, hidden)


def _changed_shares(moments: Tensor, intervals: list[tuple[int, int]]) -> np.ndarray:
    """For each interval of blocks the share of pixels with an edge that it, or the rest, has alone; the larger one.

    Args:
        moments: of blocks [K, 3, h, w].
        intervals: first block, and that after the last.
    """
    sums = torch.cat([torch.zeros_like(moments[:1]), moments.cumsum(dim=0)]).transpose(0, 1)
    at_once = max(1, VALUES_AT_ONCE // sums[:, 0].numel())
    shares = []
    for first in range(0, len(intervals), at_once):
        starts, ends = torch.tensor(intervals[first : first + at_once], device=sums.device).unbind(dim=1)
        inside, count = sums[:, ends] - sums[:, starts], (ends - starts)[:, None, None]
        parts = (inside, count), (sums[:, -1:] - inside, len(moments) - count)
        alone = [_only_in(*a, *b).float().mean(dim=(1, 2)) for a, b in (parts, parts[::-1])]
        shares.append(torch.maximum(*alone).cpu().numpy())
    return np.concatenate(shares).astype(np.float64)


def _summed(moments: Tensor) -> tuple[Tensor, Tensor]:
    """Sum of the moments of blocks, and their number."""
    return moments.sum(dim=0), torch.tensor(len(moments))


def _only_in(sums: Tensor, count: Tensor, other: Tensor, other_count: Tensor) -> Tensor:
    """Pixels [..., h, w] with a static edge that the other blocks lack, or have at most half of.

    Args:
        sums, other: of moments, [3, ..., h, w].
        count, other_count: of blocks, [..., 1, 1] or [].
    """
    mean, length, error = _mean_gradient(sums, count)
    missing, other_length, other_error = _mean_gradient(other, other_count)
    along = (mean * missing).sum(dim=0)
    least = EVIDENCE_THRESHOLDS[0] ** 2
    different = length + other_length - 2 * along >= least * (error + other_error)
    return (length >= least * error) & (along <= 0.5 * length) & different


def _mostly_missing(sums: Tensor, count: Tensor, other: Tensor, other_count: Tensor) -> Tensor:
    """Pixels [h, w] around which the other blocks lack at least half of the static edges, as in `_only_in`."""
    mean, length, error = _mean_gradient(sums, count)
    along = (mean * _mean_gradient(other, other_count)[0]).sum(dim=0)
    still = length >= EVIDENCE_THRESHOLDS[0] ** 2 * error
    planes = torch.stack([along * still, length * still])[None]
    kept, there = nn.functional.avg_pool2d(planes, 2 * CONTRAST_RADIUS + 1, 1, CONTRAST_RADIUS)[0]
    return kept <= 0.5 * there


def _mean_gradient(sums: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean gradient [2, ...], its squared length and its squared standard error with detection's floor, [...]."""
    mean = sums / count
    length = mean[:2].square().sum(dim=0)
    return mean[:2], length, (mean[2] - length).clamp_min(0) / (count - 1).clamp_min(1) + _ERROR_FLOOR
