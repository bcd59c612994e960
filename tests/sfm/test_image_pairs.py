"""The pairs of photos that are matched."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.sfm.image_pairs import exhaustive_pairs, sequential_pairs


@settings(deadline=None)
@given(st.lists(st.integers(1, 300), min_size=1, max_size=2))
def test_pairs_are_of_different_photos_each_once_and_connect_all(counts):
    passes = [[f"{number}_{photo}" for photo in range(count)] for number, count in enumerate(counts)]
    names = [name for photos in passes for name in photos]
    sequential = sequential_pairs(passes)
    assert len({frozenset(pair) for pair in sequential}) == len(sequential)
    assert all(one != other for one, other in sequential)
    reached = {names[0]}
    neighbors: dict[str, set[str]] = {name: set() for name in names}
    for one, other in sequential:
        neighbors[one].add(other)
        neighbors[other].add(one)
    left = [names[0]]
    while left:
        new = neighbors[left.pop()] - reached
        reached |= new
        left += new
    assert reached == {*names}
    # Far fewer than all pairs of a long capture.
    assert len(sequential) <= 16 * len(names) + 60 * 59 * 2 + 60 * 60
    if sum(counts) <= 40:
        assert len(exhaustive_pairs(passes)) == len(names) * (len(names) - 1) // 2
