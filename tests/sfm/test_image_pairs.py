"""The pairs of photos that are matched."""

from __future__ import annotations

from itertools import combinations

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


def test_photos_are_paired_with_their_neighbors_in_time_and_at_growing_distances():
    photos = list(range(1200))
    pairs = sequential_pairs([[str(photo) for photo in photos]])
    # Not a keyframe, which is paired with others far away.
    assert sorted(int(other) - 1 for one, other in pairs if one == "1") == [*range(1, 11), 16, 32, 64, 128, 256, 512]


def test_a_few_photos_of_each_pass_are_paired_with_those_of_the_others():
    passes = [[f"{letter}{photo}" for photo in range(400)] for letter in "abcde"]
    pairs = sequential_pairs(passes)
    for one, other in combinations("abcde", 2):
        across = [pair for pair in pairs if (pair[0][0], pair[1][0]) == (one, other)]
        assert len(across) == 30 * 30
