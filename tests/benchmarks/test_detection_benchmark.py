"""The table of hits and false alarms: its numbers are detection's, on the views it names."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.detection_rates import Command, detections, rates, spread, stretches
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("detection") / "scene"
    DemoScene(views=14, test_views=2, width=96, height=72).write(folder, None)
    return Dataset.read(folder, eval_interval=8)


def test_views_are_counted_and_an_artifact_is_found_at_each_number(clean):
    found = detections(clean, "dashboard", seed=0, chosen=[spread(16, 8), spread(16, 0)])
    assert [one.views for one in found] == [8, 16]
    assert {one.verdict for one in found} == {"opaque"}
    assert [one.verdict for one in detections(clean, None, seed=0, chosen=[spread(16, 0)])] == ["none"]


def test_the_table_has_a_row_for_each_effect_and_says_what_there_are_no_views_for(clean, capsys):
    Command((clean.root,), effects=("none", "dashboard"), views=(12, 500), seeds=1).run()
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert lines[-2:] == ["| `scene` | none | 0 of 1 | - |", lines[-1]]
    assert lines[-1].startswith("| `scene` | dashboard | 1 of 1, opaque, ")


def test_neighboring_views_come_from_three_places_and_each_is_counted(clean, capsys):
    assert stretches(16, 4) == [{0, 1, 2, 3}, {6, 7, 8, 9}, {12, 13, 14, 15}]
    assert spread(16, 4) == {0, 5, 10, 15}
    Command((clean.root,), effects=("dashboard",), views=(8, 17, 12), contiguous=True, seeds=2).run()
    row = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")][-1].split(" | ")
    assert row[2].startswith("6 of 6, opaque, ")
    assert row[3] == "-"
    assert row[4].startswith("6 of 6, opaque, ")


def test_rates_are_medians_over_turns(clean):
    ticks = iter(np.arange(100_000.0))
    prepared, summed, blocks, tested = rates(clean, repeats=1, clock=lambda: next(ticks))
    views = len(clean.views)
    assert (prepared, summed, blocks, tested) == (views, views, views, 1)
