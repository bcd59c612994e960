"""Means with intervals: paired per-view differences and their bootstrap, spread over seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

DRAWS = 2000
"""Resamples of a bootstrap interval: its ends then move by about a thirtieth of its width."""


class Interval(NamedTuple):
    """A mean and where it may lie."""

    mean: float
    low: float
    high: float


def bootstrap(groups: Sequence[Sequence[float]], level: float = 0.95, seed: int = 0) -> Interval:
    """Mean of the groups' means with a percentile bootstrap interval; values are resampled within their groups.

    Groups are what was chosen (a capture with an artifact), values what varies inside (its test views): the interval
    says how far other views of the same captures might move the mean, and nothing about other captures. Efron &
    Tibshirani 1993, chapters 8 and 13.

    Args:
        groups: at least one, none empty.
        level: share of the resamples inside the interval, in (0, 1).
        seed: of the resampling.

    Raises:
        ValueError: a group is empty, or a value is not finite.
    """
    arrays = [np.asarray(group, float) for group in groups]
    if not arrays or any(array.size == 0 or not np.isfinite(array).all() for array in arrays):
        raise ValueError("the bootstrap needs at least one group, and finite values in each")
    generator = np.random.default_rng(seed)
    resampled = np.zeros(DRAWS)
    for array in arrays:
        resampled += array[generator.integers(0, array.size, (DRAWS, array.size))].mean(axis=1)
    mean = float(np.mean([array.mean() for array in arrays]))
    low, high = np.quantile(resampled / len(arrays), [(1 - level) / 2, (1 + level) / 2])
    # Sums in another order may put the mean of equal values a rounding error outside.
    return Interval(mean, min(mean, float(low)), max(mean, float(high)))


def paired_differences(
    views: Mapping[str, Mapping[str, float | None]], other: Mapping[str, Mapping[str, float | None]], metric: str
) -> list[float]:
    """Metric of one run minus that of another, view by view, over the views that both have and where it is finite."""
    pairs = [(views[name].get(metric), other[name].get(metric)) for name in views if name in other]
    return [a - b for a, b in pairs if a is not None and b is not None and math.isfinite(a) and math.isfinite(b)]


def spread(values: Sequence[float]) -> float | None:
    """Sample standard deviation; None for fewer than two values."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def percent_change(times: np.ndarray, reference: np.ndarray) -> str:
    """Median change of paired times [N] in percent with its 95 % bootstrap interval, as text."""
    percent = 100 * (times / reference - 1)
    found = stats.bootstrap((percent,), np.median, method="percentile", rng=np.random.default_rng(0))
    low, high = found.confidence_interval
    return f"{np.median(percent):+.2f} % (95 %: {low:+.2f} to {high:+.2f} %)"
