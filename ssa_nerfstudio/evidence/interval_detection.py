"""Detection in a capture whose artifact changes: each interval is tested by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import reduce

import torch
from torch import Tensor

from ssa_nerfstudio.evidence.change_points import change_points
from ssa_nerfstudio.evidence.detection import DRAWS, Detection, Interval, detect
from ssa_nerfstudio.evidence.statistics import ImageStatistics

_STRENGTH = ("none", "faint", "opaque")


def detect_in_intervals(
    photos: Callable[[], Iterable[Tensor]], draws: int = DRAWS, whole: ImageStatistics | None = None
) -> Detection:
    """Test whether the photos of a camera have an artifact, static at least for a while.

    The photos are read once; where the artifact changes, a second time.

    Args:
        photos: yields all photos of the camera, in the order of the capture, each [H, W, 3].
        draws: shifted captures in the null distributions.
        whole: statistics of all photos, where they are known: the photos are then read only where the artifact changes.

    Returns:
        The detection. Where the artifact changes, `intervals` says when; mask and opaque area are what any of them has,
        and verdict and p-value those of the interval with the strongest evidence.
    """
    if whole is None:
        (whole,) = _statistics(photos(), [])
    cuts = change_points(whole, draws)
    if not cuts:
        return detect(whole, draws)
    found = [detect(statistics, draws) for statistics in _statistics(photos(), cuts)]
    starts = [0, *cuts]
    intervals = tuple(
        Interval(start, start + one.views, one.verdict, one.coverage) for start, one in zip(starts, found, strict=True)
    )
    strongest = max(found, key=lambda one: (_STRENGTH.index(one.verdict), one.coverage))
    mask, opaque = (reduce(torch.logical_or, masks) for masks in zip(*((d.mask, d.opaque) for d in found), strict=True))
    return replace(
        strongest,
        coverage=float(mask.float().mean()),
        views=sum(one.views for one in found),
        evidence=torch.stack([one.evidence for one in found]).amax(dim=0),
        mask=mask,
        opaque=opaque,
        intervals=intervals,
    )


def _statistics(photos: Iterable[Tensor], cuts: list[int]) -> list[ImageStatistics]:
    """Of each interval; `cuts` are the first photos of all but the first."""
    statistics = [ImageStatistics() for _ in range(len(cuts) + 1)]
    for number, photo in enumerate(photos):
        statistics[sum(number >= cut for cut in cuts)].add(photo)
    return statistics
