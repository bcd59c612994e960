"""The clock of a training stands still while views are evaluated."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from ssa_nerfstudio.experiments.runs.run_timing import StepClock, mean_metrics

STEP, EVALUATION, STATISTICS = 2.0, 100.0, 7.0


@pytest.fixture
def now(monkeypatch) -> list[float]:
    """Seconds that have passed; a test adds to them."""
    passed = [1000.0]
    monkeypatch.setattr("time.perf_counter", lambda: passed[0])
    return passed


@pytest.mark.parametrize("marks", [(), (3,), (2, 5), (2, 4, 5, 6)])
def test_evaluations_are_no_part_of_the_training(now, marks):
    model = SimpleNamespace(device=torch.device("cpu"), num_points=11)
    pipeline: Any = SimpleNamespace(model=model, statistics_seconds=STATISTICS)
    told = []

    def judge() -> dict[str, dict[str, float]]:
        now[0] += EVALUATION
        return {"a": {"psnr": 10.0}, "b": {"psnr": 20.0}}

    clock = StepClock(pipeline, 6, marks, told.append, judge)
    now[0] += 50  # of setting up
    clock.start()
    for step in range(6):
        now[0] += STEP
        clock.after_step(step)
    assert told == [1, 2, 3, 4, 5, 6]
    assert clock.training == 6 * STEP
    assert clock.paused == EVALUATION * len(marks)
    assert [point["step"] for point in clock.curve] == [*marks]
    assert [point["seconds"] for point in clock.curve] == [STATISTICS + STEP * mark for mark in marks]
    assert all((point["psnr"], point["gaussians"]) == (15.0, 11) for point in clock.curve)
    assert clock.peak_memory_mb > 1


def test_metrics_are_averaged_over_views():
    assert mean_metrics({"a": {"psnr": 10.0, "flip": 0.1}, "b": {"psnr": 30.0, "flip": 0.4}}) == pytest.approx(
        {"psnr": 20.0, "flip": 0.25}
    )
