"""PSNR over the number of steps, from results made up."""

from __future__ import annotations

import dataclasses

import pytest
from made_results import benchmark, folder_of, result

from benchmarks.lengths_figure import Command
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Part, Tradeoff
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan, plan_tradeoff

OTHERS = {"ssim": 0.8, "flip": 0.2}


def made(folder, with_bars: bool = True):
    """Two lengths of each capture's default, two seeds, and other runs, which are no part of a curve or bar."""
    tradeoff = Tradeoff(
        ("attic", "barn"), "mud", {"steps": [1000]}, ({"image_scale": 0.5},), steps=4000, seeds=(0, 1), marks=1
    )
    file = benchmark(tradeoff=tradeoff, parts=(Part(("3dgs",), steps=30_000),))
    runs = [
        result(run, metrics={"psnr": 20 + run.steps / 1000 + run.seed - 9 * (run.image_scale < 1), **OTHERS})
        for run in plan_tradeoff(file)
    ]
    runs = [dataclasses.replace(each, alone=each.run.scene == "attic") for each in runs]
    bars = [result(run, metrics={"psnr": 25.0, **OTHERS}) for run in plan(file)]
    parts = Part(("paper",), steps=30_000), Part(("3dgs",), steps=7000)
    others = [result(run, metrics={"psnr": 99.0, **OTHERS}) for run in plan(benchmark(parts=parts))]
    return folder_of(folder, runs + others + (bars if with_bars else []))


def test_a_row_for_each_curve_and_seconds_of_runs_that_were_alone(tmp_path, capsys):
    Command(made(tmp_path / "made"), tmp_path / "figure.svg").run()
    rows = {line.split("|")[1].strip(): line for line in capsys.readouterr().out.splitlines()}
    assert rows["`attic`"] == "| `attic` | ADC | 21.50 (11 s) | 24.50 (41 s) | 25.00 |"
    assert rows["`barn`"] == "| `barn` | ADC | 21.50 | 24.50 | 25.00 |"
    drawn = (tmp_path / "figure.svg").read_text()
    assert "10.2 ms a step" in drawn or "10.6 ms a step" in drawn


def test_a_capture_without_a_bar_is_named(tmp_path):
    with pytest.raises(InputError, match="no bar of attic, barn"):
        Command(made(tmp_path / "made", with_bars=False), tmp_path / "figure.svg").run()
    (tmp_path / "empty" / "results").mkdir(parents=True)
    with pytest.raises(InputError, match="no run of several lengths"):
        Command(tmp_path / "empty", tmp_path / "figure.svg").run()
    assert not (tmp_path / "figure.svg").exists()
