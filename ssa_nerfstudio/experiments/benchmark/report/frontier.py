"""Quality against seconds: the Pareto frontier, its knee, and what a decibel costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple


class Point(NamedTuple):
    """What a training had reached after some seconds."""

    seconds: float
    quality: float


class Step(NamedTuple):
    """The price of getting from one quality to a better one."""

    start: float
    """Quality at the beginning."""
    end: float
    seconds: float
    """Seconds at which the end is reached."""
    more: float
    """Seconds beyond what the beginning took."""


def frontier(points: Sequence[Point]) -> list[Point]:
    """The points that no other beats: none is as good in fewer seconds, none better in as many. By seconds.

    Both strictly increase along it. Points whose quality or seconds are not finite count for nothing.
    """
    best = -math.inf
    kept = []
    usable = [p for p in points if math.isfinite(p.seconds) and math.isfinite(p.quality)]
    for point in sorted(usable, key=lambda p: (p.seconds, -p.quality)):
        if point.quality > best:
            kept.append(point)
            best = point.quality
    return kept


def knee(front: Sequence[Point]) -> Point | None:
    """Where a frontier bends most: the point farthest above the chord from its first to its last point.

    Over the logarithm of seconds, because every further decibel takes a multiple of the time; both axes scaled to
    [0, 1] (Satopaa et al. 2011, "Finding a kneedle in a haystack"). Which unit the seconds have does not matter, nor
    do offset and unit of the quality.

    Args:
        front: as `frontier` gives it, seconds positive.

    Returns:
        A point of the frontier between its ends; None where none lies above the chord.
    """
    if len(front) < 3:
        return None
    first, last = front[0], front[-1]
    width = math.log(last.seconds) - math.log(first.seconds)
    height = last.quality - first.quality

    def above(point: Point) -> float:
        along = (math.log(point.seconds) - math.log(first.seconds)) / width
        return (point.quality - first.quality) / height - along

    best = max(front[1:-1], key=above)
    return best if above(best) > 1e-9 else None


def price(front: Sequence[Point], size: float = 1.0) -> list[Step]:
    """What every further unit of quality costs along a frontier, counted back from its best point.

    Qualities are best, best - size, best - 2 size, ... ; each is paid by the first point that reaches it.

    Args:
        front: as `frontier` gives it.
        size: of a step, positive.

    Returns:
        Steps by quality, the last one ends at the best point.
    """
    if len(front) < 2:
        return []
    best = front[-1].quality
    count = int((best - front[0].quality) / size + 1e-9)
    levels = [best - size * k for k in range(count, -1, -1)]
    # Levels but the best are rounded; the best is the last point's, even where one before is as good up to rounding.
    reached = [next(p.seconds for p in front if p.quality >= level - 1e-9) for level in levels[:-1]]
    reached.append(front[-1].seconds)
    return [Step(levels[k], levels[k + 1], reached[k + 1], reached[k + 1] - reached[k]) for k in range(len(levels) - 1)]
