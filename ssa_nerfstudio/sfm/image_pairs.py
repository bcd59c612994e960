"""Choice of the pairs of photos that are matched."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

EXHAUSTIVE_UP_TO = 150
"""Number of photos, of all passes together, up to which every pair is matched: 11175 pairs."""
_NEIGHBORS = 10
_MAX_KEYFRAMES = 60


def exhaustive_pairs(passes: Sequence[Sequence[str]]) -> list[tuple[str, str]]:
    """All pairs of photos, of the same pass or not."""
    return list(combinations([name for photos in passes for name in photos], 2))


def sequential_pairs(passes: Sequence[Sequence[str]]) -> list[tuple[str, str]]:
    """Pairs of photos that are near in time, and of keyframes that are not.

    Every photo is paired with the 10 that follow it in its pass and with those 16, 32, ..., 512 further on. In addition
    evenly spaced keyframes of each pass (60, of more than two passes 150 together) are paired with each other, also
    across passes: they close loops and connect the passes, without a vocabulary tree.

    Args:
        passes: each pass's photos in order.

    Returns:
        Pairs, each once, in order.
    """
    steps = [*range(1, _NEIGHBORS + 1), *(2**power for power in range(4, 10))]
    pairs: dict[tuple[str, str], None] = {}
    for photos in passes:
        for step in steps:
            pairs.update(dict.fromkeys(zip(photos, photos[step:], strict=False)))
    most = min(_MAX_KEYFRAMES, EXHAUSTIVE_UP_TO // max(1, len(passes)))
    keyframes = [_keyframes(photos, most) for photos in passes]
    for each in keyframes:
        pairs.update(dict.fromkeys(combinations(each, 2)))
    for one, other in combinations(keyframes, 2):
        pairs.update(dict.fromkeys(product(one, other)))
    return list(pairs)


def _keyframes(photos: Sequence[str], most: int) -> list[str]:
    """At most so many photos, evenly spaced, the first and the last among them."""
    count = min(most, len(photos))
    return [photos[round(number * (len(photos) - 1) / max(count - 1, 1))] for number in range(count)]
