"""Tradeoffs from made-up curves: who is on the frontier, what it costs, what is written."""

from __future__ import annotations

import csv
import dataclasses
import itertools

import pytest
from made_results import benchmark, folder_of, result
from PIL import Image

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.execution import warm_up
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import ResultsFolder
from ssa_nerfstudio.experiments.benchmark.report.tradeoff_report import analyze
from ssa_nerfstudio.experiments.benchmark.results import Result
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Tradeoff
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan_tradeoff

SECONDS = {"base": 8.0, "overlay_downscale 2": 6.0, "steps 1000": 1.0, "steps 1000, image_scale 0.5": 0.8}
"""Seconds at the end of each run."""


def curves() -> list[Result]:
    tradeoff = Tradeoff(
        ("barn",),
        knobs={"steps": [1000], "overlay_downscale": [2]},
        together=({"steps": 1000, "image_scale": 0.5},),
        marks=3,
    )
    made = []
    for run in plan_tradeoff(benchmark(tradeoff=tradeoff)):
        name = ", ".join(f"{knob} {value}" for knob, value in run.variation.items()) or "base"
        end = SECONDS[name]
        curve = [
            {
                "step": step,
                "seconds": end * step / run.steps,
                "psnr": 18.0 + k + (end > 2) * 2 + 2 * (k == 2) + (name == "base"),
                "ssim": 0.7,
                "flip": 0.2,
                "gaussians": 100.0,
            }
            for k, step in enumerate(run.marks)
        ]
        command = f"ssa tradeoff made --output here --only {run.id}"
        made.append(dataclasses.replace(result(run), curve=curve, command=command))
    return made


IDS = {made.run.id for made in curves()}


def points(folder) -> list[dict[str, str]]:
    with (folder / "tradeoff.csv").open() as file:
        return list(csv.DictReader(file))


def test_every_point_is_written_with_its_command_and_the_frontier_marked(tmp_path):
    files, problems = analyze([folder_of(tmp_path, curves())], tmp_path / "out", IDS)
    assert problems == []
    rows = points(tmp_path / "out")
    assert len(rows) == 4 * 3
    assert {row["setting"] for row in rows} == set(SECONDS)
    assert all(row["command"].endswith(row["run"]) for row in rows)
    best = max(rows, key=lambda row: float(row["psnr"]))
    assert (best["setting"], best["on_frontier"]) == ("base", "1")
    on = sorted((float(r["seconds"]), float(r["psnr"])) for r in rows if r["on_frontier"] == "1")
    assert all(a[1] < b[1] for a, b in itertools.pairwise(on))
    assert sum(row["knee"] == "1" for row in rows) == 1
    assert {path.suffix for path in files} == {".csv", ".png", ".svg", ".md", ".html"}
    with Image.open(tmp_path / "out" / "barn-dashboard-cpu.png") as figure:
        assert min(figure.size) > 800


def test_a_run_that_shared_its_device_is_on_no_frontier(tmp_path):
    made = curves()
    alone = [dataclasses.replace(r, alone=r.run.variation != {}) for r in made]
    _, problems = analyze([folder_of(tmp_path, alone)], tmp_path / "out", IDS)
    assert len(problems) == 1
    assert made[0].run.id in problems[0]
    rows = points(tmp_path / "out")
    assert {row["on_frontier"] for row in rows if row["setting"] == "base"} == {"0"}
    assert "1" in {row["on_frontier"] for row in rows}
    text = (tmp_path / "out" / "tradeoff.md").read_text()
    assert "(shared)" in text
    assert "What 1 dB costs" in text


def test_without_any_run_alone_there_are_curves_but_no_frontier(tmp_path):
    shared = [dataclasses.replace(r, alone=False) for r in curves()]
    analyze([folder_of(tmp_path, shared)], tmp_path / "out", IDS)
    assert {row["on_frontier"] for row in points(tmp_path / "out")} == {"0"}
    text = (tmp_path / "out" / "tradeoff.md").read_text()
    assert "there is no frontier" in text
    assert "What 1 dB costs" not in text


def test_gpu_and_cpu_are_never_on_one_frontier(tmp_path):
    made = curves()
    made[0] = dataclasses.replace(made[0], versions={**made[0].versions, "device": "NVIDIA H200"})
    analyze([folder_of(tmp_path, made)], tmp_path / "out", IDS)
    assert (tmp_path / "out" / "barn-dashboard-gpu.png").exists()
    assert (tmp_path / "out" / "barn-dashboard-cpu.png").exists()


def test_prices_and_knobs_are_those_of_the_curves(tmp_path):
    analyze([folder_of(tmp_path, curves())], tmp_path / "out", IDS)
    text = (tmp_path / "out" / "tradeoff.md").read_text()
    assert "Base: overlay_downscale default, steps 7000" in text
    # overlay_downscale 2 ends 1 dB below the base and 2 s earlier: 2 s for each dB.
    assert "| overlay_downscale 2 | 24.00 | 0.700 | 0.200 | 6.0 | 100 | -1.00 | -2.0 | 2.0 |" in text


def test_an_infinite_psnr_and_a_start_without_seconds_are_no_points(tmp_path):
    made = curves()
    made[0].curve[0]["psnr"] = float("inf")
    made[1].curve[0]["seconds"] = 0.0
    analyze([folder_of(tmp_path, made)], tmp_path / "out", IDS)
    assert len(points(tmp_path / "out")) == 4 * 3 - 2


def test_a_folder_without_curves_is_refused(tmp_path):
    with pytest.raises(InputError, match="no finished run of ssa tradeoff"):
        analyze([folder_of(tmp_path, [])], tmp_path / "out", IDS)


def test_missing_runs_are_named(tmp_path):
    made = curves()
    analyze([folder_of(tmp_path, made[1:])], tmp_path / "out", IDS)
    text = (tmp_path / "out" / "tradeoff.md").read_text()
    assert f"missing are 1 of 4 that were planned: `{made[0].run.id}`." in text
    analyze([folder_of(tmp_path, made)], tmp_path / "out", IDS)
    assert "missing are 0 of 4 that were planned." in (tmp_path / "out" / "tradeoff.md").read_text()


def test_kernels_are_compiled_by_short_runs_that_leave_nothing(tmp_path, monkeypatch):
    """One for each size of photos and densification, on the datasets that are there."""
    trained = []

    class Runner:
        def __init__(self, place, devices, *_):
            self.place, self.devices = place, devices

        def work(self, runs, *_):
            for run in runs:
                assert (self.place.scenes / run.dataset / "photo").exists()
                trained.append((run.steps, run.marks, run.image_scale, run.densification, self.devices))
            (self.place.folder / "results").mkdir()

    monkeypatch.setattr(warm_up, "DaskRunner", Runner)
    tradeoff = Tradeoff(("barn",), knobs={"steps": [1000], "image_scale": [0.5], "densification": ["mcmc"]})
    runs = plan_tradeoff(benchmark(tradeoff=tradeoff))
    (tmp_path / "scenes" / runs[0].dataset).mkdir(parents=True)
    (tmp_path / "scenes" / runs[0].dataset / "photo").touch()
    before = sorted(tmp_path.rglob("*"))
    assert warm_up.warm_up(runs, ResultsFolder(tmp_path), "3", None) == 3
    assert sorted(trained) == [
        (60, (), 0.5, "adc", ["3"]),
        (60, (), 1.0, "adc", ["3"]),
        (60, (), 1.0, "mcmc", ["3"]),
    ]
    assert sorted(tmp_path.rglob("*")) == before
