"""Results made up for tests of what is done with them: every number follows from the run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ssa_nerfstudio.experiments.benchmark.results import Result, write
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Benchmark, Part, SceneEntry
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run, plan

GAIN = {"3dgs": -4.0, "default": 0.5, "overlay-on": 0.4, "paper": 0.0, "given": 0.3, "constant-start": -1.0}
"""PSNR of a method above that of the paper's rule."""


def benchmark(**changes) -> Benchmark:
    """Two scenes, two artifacts and clean photos, six methods, two seeds, both densifications."""
    part = Part(
        methods=("3dgs", "default", "paper", "given", "l1-0", "constant-start"),
        effects=("none", "dashboard", "mud"),
        densification=("adc", "mcmc"),
        seeds=(0, 1),
        steps=700,
    )
    scenes = (SceneEntry("$SSA_DATA/attic"), SceneEntry("$SSA_DATA/barn"))
    return dataclasses.replace(Benchmark(scenes, (part,), name="made"), **changes)


def result(run: Run, **changes) -> Result:
    """A finished run: 20 dB and GAIN, 1 dB more under MCMC, 0.1 dB a seed, views 1 dB apart around that."""
    psnr = 20.0 + GAIN.get(run.method, -2.0) + (run.densification == "mcmc") + 0.1 * run.seed
    views: dict[str, dict[str, Any]] = {
        f"view_{k}.png": {"psnr": psnr + k - 1, "ssim": 0.8, "flip": 0.2, "mean_color_deviation": 5.0} for k in range(3)
    }
    return dataclasses.replace(
        Result(
            run,
            "finished",
            metrics={"psnr": psnr, "ssim": 0.8, "flip": 0.2, "mean_color_deviation": 5.0},
            views=views,
            seconds={"startup": 5.0, "statistics": 1.0, "training": run.steps / 100, "evaluation": 2.0},
            alone=True,
            gaussians=1000,
            peak_memory_mb=500.0,
            versions={"device": "CPU, 1 threads", "torch": "2", "gsplat": "1.4.0"},
            revision="abc",
            command=f"ssa bench made --output results --only {run.id}",
        ),
        **changes,
    )


def folder_of(path: Path, results: list[Result]) -> Path:
    """A folder of `ssa bench` with these results."""
    for each in results:
        write(each, path / "results" / f"{each.run.id}.json")
    return path


def all_results(**changes) -> list[Result]:
    """A result for every run of `benchmark`."""
    return [result(run) for run in plan(benchmark(**changes))]
