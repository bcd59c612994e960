"""Which pairs of photos are matched."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

EXHAUSTIVE_UP_TO = 150
"""Photos of all passes together up to which every pair is matched: 11175 pairs."""
_NEIGHBOURS = 10
_KEYFRAMES = 60


def exhaustive_pairs(passes: Sequence[Sequence[str]]) -> list[tuple[str, str]]:
    """Every pair of photos, of the same pass or not."""
    return list(combinations([name for photos in passes for name in photos], 2))


def sequential_pairs(passes: Sequence[Sequence[str]]) -> list[tuple[str, str]]:
    """Pairs of photos that lie near each other in time, and a net over everything.

    Every photo is paired with the 10 that follow it in its pass and with those 16, 32, ..., 512 further on. The net is
    every pair of 60 evenly spaced photos of each pass, and all their pairs across passes: it closes loops and ties the
    passes together, without a vocabulary tree.

    Args:
        passes: each pass's photos in order.

    Returns:
        Pairs, each once, in order.
    """
    steps = [*range(1, _NEIGHBOURS + 1), *(2**power for power in range(4, 10))]
    pairs: dict[tuple[str, str], None] = {}
    for photos in passes:
        for step in steps:
            pairs.update(dict.fromkeys(zip(photos, photos[step:], strict=False)))
    nets = [_spread(photos) for photos in passes]
    for net in nets:
        pairs.update(dict.fromkeys(combinations(net, 2)))
    for one, other in combinations(nets, 2):
        pairs.update(dict.fromkeys(product(one, other)))
    return list(pairs)


def _spread(photos: Sequence[str]) -> list[str]:
    """At most 60 photos, evenly spaced, the first and the last among them."""
    count = min(_KEYFRAMES, len(photos))
    return [photos[round(number * (len(photos) - 1) / max(count - 1, 1))] for number in range(count)]
