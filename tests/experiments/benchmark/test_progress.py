"""The live table, as a terminal and as a log file see it."""

from __future__ import annotations

import dataclasses
import io
import time
from dataclasses import dataclass
from typing import Any

import pytest
from made_results import benchmark, result
from rich.console import Console

from ssa_nerfstudio.experiments.benchmark.execution.progress_table import ProgressTable
from ssa_nerfstudio.experiments.benchmark.results import Result
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run, plan

RUNS = plan(benchmark())[:4]


@dataclass
class Working:
    """What the table asks of a request."""

    run: Run
    device: str
    asked: float

    def state(self) -> tuple[str, int]:
        return "training", 50


def drawn(terminal: bool, ended: list[tuple[Run, Result | None]]) -> str:
    """What is printed of four runs: the first was done before, the third works, the last waits."""
    stream = io.StringIO()
    request: Any = Working(RUNS[2], "3", time.time() - 61)
    with ProgressTable(Console(file=stream, force_terminal=terminal, width=200), len(RUNS), 1, 1) as table:
        for run, outcome in ended:
            table.ended(run, outcome)
        table.watch([request], 1)
    return stream.getvalue()


def test_a_terminal_shows_what_runs_how_far_and_when_all_will_be_over():
    outcome = dataclasses.replace(result(RUNS[1]), seconds={"startup": 20.0, "training": 100.0})
    text = drawn(True, [(RUNS[1], outcome)])
    assert f"[2/4] {RUNS[1].id}: PSNR" in text
    row = next(line for line in text.splitlines() if RUNS[2].id in line)
    assert all(word in row for word in ("GPU 3", "training", f"50 / {RUNS[2].steps}"))
    assert row.rstrip().endswith(("61", "62"))
    assert "2 of 4 done, 1 running, 1 waiting; about 3 min left" in text


@pytest.mark.parametrize("status", ["failed", "diverged"])
def test_trouble_is_counted_and_said(status):
    outcome = dataclasses.replace(result(RUNS[1]), status=status, reason="the disk is full")
    text = drawn(True, [(RUNS[1], outcome)])
    assert f"{RUNS[1].id}: {status}: the disk is full" in text
    assert f"1 waiting; 1 {status}" in text
    assert "min left" not in text


def test_a_log_file_gets_a_line_for_every_run_that_ends_and_nothing_else():
    text = drawn(False, [(RUNS[1], result(RUNS[1])), (RUNS[2], None)])
    first, second = text.splitlines()
    assert first.startswith(f"[2/4] {RUNS[1].id}: PSNR")
    assert second == f"[3/4] {RUNS[2].id}: its process ended without a result; see its log"
