"""Bootstrap intervals and paired differences: properties, and a comparison with the normal approximation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssa_nerfstudio.experiments.benchmark.report.bootstrap import bootstrap, paired_differences, spread

values = st.floats(-100, 100)
groups = st.lists(st.lists(values, min_size=1, max_size=12), min_size=1, max_size=4)


@given(groups)
def test_the_interval_holds_the_mean_and_lies_within_the_values(data):
    interval = bootstrap(data)
    lowest, highest = (np.mean([end(group) for group in data]) for end in (min, max))
    assert lowest - 1e-9 <= interval.low <= interval.mean <= interval.high <= highest + 1e-9
    assert interval.mean == pytest.approx(np.mean([np.mean(group) for group in data]))


@given(groups, st.floats(-50, 50), st.floats(0.1, 10))
def test_the_interval_moves_and_stretches_with_the_values(data, offset, factor):
    plain = bootstrap(data)
    moved = bootstrap([[factor * value + offset for value in group] for group in data])
    np.testing.assert_allclose(moved, [factor * value + offset for value in plain], atol=1e-6)


def test_of_many_values_it_is_the_normal_interval():
    data = np.random.default_rng(3).normal(2.0, 1.0, 400)
    interval = bootstrap([data.tolist()])
    half = 1.96 * data.std() / np.sqrt(len(data))
    np.testing.assert_allclose(interval, [data.mean(), data.mean() - half, data.mean() + half], atol=0.15 * half)


def test_it_covers_the_truth_about_as_often_as_it_says():
    generator = np.random.default_rng(0)
    samples = [bootstrap([generator.normal(1.0, 2.0, 30).tolist()], seed=k) for k in range(200)]
    covered = np.mean([interval.low <= 1.0 <= interval.high for interval in samples])
    assert 0.88 <= covered <= 0.99


@pytest.mark.parametrize("data", [[], [[]], [[1.0], []], [[float("nan")]]])
def test_it_refuses_what_has_no_mean(data):
    with pytest.raises(ValueError, match="at least one group"):
        bootstrap(data)


def test_differences_are_paired_by_view_and_skip_what_one_run_lacks():
    ours = {"a": {"psnr": 3.0}, "b": {"psnr": 5.0}, "c": {"psnr": None}, "d": {"psnr": 1.0}}
    theirs = {"b": {"psnr": 4.0}, "a": {"psnr": 1.0}, "c": {"psnr": 2.0}}
    assert sorted(paired_differences(ours, theirs, "psnr")) == [1.0, 2.0]  # pyright: ignore[reportArgumentType]


def test_one_seed_has_no_spread():
    assert spread([3.0]) is None
    assert spread([1.0, 3.0]) == pytest.approx(2**0.5)
