"""The parallel map over threads."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from ssa_nerfstudio._system.ordered_map import ordered_map


def test_results_come_in_the_order_of_the_items():
    def slow_first(item: int) -> int:
        time.sleep(0.02 if item == 0 else 0)
        return item * item

    assert list(ordered_map(slow_first, range(20), threads=4)) == [n * n for n in range(20)]


def test_items_are_consumed_as_results_are_read():
    """A long capture is not decoded into memory before the first photo is used."""
    consumed = 0

    def items() -> Iterator[int]:
        nonlocal consumed
        for number in range(1, 1001):
            consumed = number
            yield number

    results = ordered_map(lambda item: item, items(), threads=2)
    assert next(results) == 1
    assert consumed == 5
    del results


def test_an_error_reaches_the_reader_in_its_place():
    def fails_at_three(item: int) -> int:
        if item == 3:
            raise ArithmeticError("three")
        return item

    results = ordered_map(fails_at_three, range(10), threads=2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ArithmeticError, match="three"):
        next(results)
