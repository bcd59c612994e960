"""Tests for a change: those of its statement, the quickest file first."""

from __future__ import annotations

import pytest

from benchmarks.mutation.picking import quickest_first, statement

FUNCTION = '''
    def f(a,
          b=2):
        """What it does."""
        if a > b and (
            a > 3
        ):
            return [
                a,
                b,
            ]
        for x in range(a):
            b += x
        return b
'''
LINES: list[str] = [str(line) for line in FUNCTION.strip("\n").splitlines()]


@pytest.mark.parametrize(
    ("line", "first", "last"),
    [
        ("b=2", "What it does", "return b"),  # of a signature, all of the body
        ("if a > b", "if a > b", "):"),
        ("a > 3", "if a > b", "):"),
        ("                b,", "return [", "]"),
        ("for x", "for x", "for x"),
        ("b += x", "b += x", "b += x"),
        ("return b", "return b", "return b"),
    ],
)
def test_a_change_is_run_where_its_statement_is_and_a_compound_one_where_its_head_is(line, first, last):
    (place,) = [number for number, text in enumerate(LINES) if line in text]
    found = [LINES[number] for number in statement(LINES, place)]
    assert first in found[0]
    assert last in found[-1]


def test_tests_of_a_file_stay_together_and_the_quickest_file_comes_first():
    seconds = {"slow.py::a": 1.0, "slow.py::b": 30.0, "quick.py::a": 3.0, "quick.py::b": 2.0, "other.py::a": 90.0}
    order = ["quick.py::b", "quick.py::a", "slow.py::a", "slow.py::b"]
    assert quickest_first([*seconds], seconds, 60) == (order, 36.0)
    assert quickest_first([*seconds], seconds, 6) == (order[:3], 6.0)


def test_one_test_is_tried_however_long_it_takes():
    assert quickest_first(["a.py::a"], {"a.py::a": 500.0}, 60) == (["a.py::a"], 500.0)
    assert quickest_first([], {}, 60) == ([], 0.0)
