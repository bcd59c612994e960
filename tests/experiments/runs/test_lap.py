"""Laps: what lies between their beginning and their end counts, and nothing after."""

from __future__ import annotations

import time

from ssa_nerfstudio.experiments.runs.lap import Lap


def test_a_lap_is_as_long_as_what_lies_in_it():
    begin = time.perf_counter()
    lap = Lap()
    time.sleep(0.05)
    lap.end()
    around = time.perf_counter() - begin
    time.sleep(0.1)
    assert 0.049 < lap.seconds() < around + 0.001  # of an event's clock
    assert lap.seconds() == lap.seconds()
