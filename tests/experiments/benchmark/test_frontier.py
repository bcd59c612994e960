"""Frontier, knee and price: properties over random points, and cases worked by hand."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ssa_nerfstudio.experiments.benchmark.report.frontier import Point, frontier, knee, price

points = st.lists(st.builds(Point, st.floats(0.1, 1e4), st.floats(0, 40)), max_size=40)


@given(points)
def test_nobody_beats_a_point_of_the_frontier_and_all_others_are_beaten(cloud):
    front = frontier(cloud)
    for point in cloud:
        beaten = any(p.seconds <= point.seconds and p.quality >= point.quality and p != point for p in cloud)
        assert beaten == (point not in front)


@given(points)
def test_the_frontier_climbs_and_is_its_own_frontier(cloud):
    front = frontier(cloud)
    for before, after in itertools.pairwise(front):
        assert before.seconds < after.seconds
        assert before.quality < after.quality
    assert frontier(front) == front
    assert set(front) <= set(cloud)
    assert frontier([*cloud, Point(1.0, math.nan), Point(math.inf, 50.0)]) == front


@given(points)
def test_the_knee_is_inside_the_frontier_and_above_its_chord(cloud):
    front = frontier(cloud)
    bend = knee(front)
    if bend is None:
        return
    assert bend in front[1:-1]
    first, last = front[0], front[-1]
    along = math.log(bend.seconds / first.seconds) / math.log(last.seconds / first.seconds)
    assert bend.quality > first.quality + along * (last.quality - first.quality)


whole = st.lists(st.builds(Point, st.integers(1, 1000).map(float), st.integers(0, 40).map(float)), max_size=20)


@given(whole, st.sampled_from([0.25, 8.0]), st.sampled_from([0.5, 4.0]), st.integers(-20, 20))
def test_units_do_not_move_the_knee(cloud, seconds, unit, offset):
    moved = knee(frontier([Point(p.seconds * seconds, p.quality * unit + offset) for p in cloud]))
    plain = knee(frontier(cloud))
    if plain is None or moved is None:
        assert plain is moved
        return
    # Two points may lie equally far above the chord within rounding.
    height = [
        _above(frontier(cloud), p) for p in (plain, Point(moved.seconds / seconds, (moved.quality - offset) / unit))
    ]
    assert height[0] == pytest.approx(height[1], abs=1e-9)


def _above(front: list[Point], point: Point) -> float:
    first, last = front[0], front[-1]
    along = math.log(point.seconds / first.seconds) / math.log(last.seconds / first.seconds)
    return (point.quality - first.quality) / (last.quality - first.quality) - along


def test_the_knee_of_a_corner_is_the_corner_and_a_line_has_none():
    assert knee([Point(1, 0), Point(2, 9), Point(100, 10)]) == Point(2, 9)
    assert knee([Point(1, 0), Point(10, 1), Point(100, 2)]) is None
    assert knee([Point(1, 0), Point(50, 1), Point(100, 10)]) is None
    assert knee([Point(1, 0), Point(2, 1)]) is None


@given(points)
@example([Point(1, 40 - 1e-14), Point(2, 40), Point(0.5, 0)])
def test_prices_add_up_to_what_the_frontier_costs(cloud):
    front = frontier(cloud)
    steps = price(front)
    assert all(step.more >= 0 and step.end == pytest.approx(step.start + 1) for step in steps)
    if steps:
        assert steps[-1].end == pytest.approx(front[-1].quality)
        assert steps[-1].seconds == front[-1].seconds
        started = steps[0].seconds - steps[0].more
        assert sum(step.more for step in steps) == pytest.approx(front[-1].seconds - started)
        assert steps[0].start - front[0].quality < 1


def test_a_decibel_is_paid_by_the_first_point_that_reaches_it():
    front = [Point(1, 20.0), Point(2, 21.5), Point(10, 22.5), Point(30, 23.0)]
    assert [(s.end, s.seconds, s.more) for s in price(front)] == [(21.0, 2, 1), (22.0, 10, 8), (23.0, 30, 20)]
