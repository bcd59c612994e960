"""Intervals of a capture: photos between two changes of an artifact, named by the first photo of each."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from pathlib import PurePosixPath

from ssa_nerfstudio._system.natural_order import natural_order

BEGINNING = ""
"""Start of the first interval."""


def interval_at(photo: str, starts: Sequence[str]) -> int:
    """Find the interval that a photo lies in.

    Args:
        photo: its path relative to the dataset.
        starts: the path of each interval's first photo, or BEGINNING; in any order.

    Returns:
        An index of `starts`. A photo before all of them is in the first.
    """
    order = sorted(range(len(starts)), key=lambda index: capture_order(starts[index]))
    after = bisect_right([capture_order(starts[index]) for index in order], capture_order(photo))
    return order[max(after - 1, 0)]


def capture_order(photo: str) -> list[list[tuple[int, str]]]:
    """Sort key of a capture's photos: their path in natural order, without its first folder, images/ or images_2/."""
    parts = PurePosixPath(photo).parts
    return [natural_order(part) for part in parts[1:] or parts]
