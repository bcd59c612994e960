"""Kernels are compiled before any clock runs: by short trainings whose results are thrown away.

What Triton, numba and gsplat compile stays on the machine's disk, so the first run that is timed is comparable.
"""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

from ssa_nerfstudio.experiments.benchmark.execution.dask_runner import DaskRunner
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import ResultsFolder
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run

STEPS = 60
"""Schedules are scaled to them: every resolution, densification and degree of the colors has its turn."""


def warm_up(runs: list[Run], place: ResultsFolder, device: str | None, deadline: float | None) -> int:
    """Train shortly what the runs do, one for each kind of kernels; whether it succeeds, the runs will tell.

    Args:
        runs: what will be timed, with their datasets prepared.
        place: the output folder.
        device: CUDA device; None: the CPU. Machines of a cluster are not reached.
        deadline: `time.monotonic()` by which it has to be over; None: never.

    Returns:
        How many trainings that were.
    """
    # Triton compiles anew where a size is divisible by 16 that was not before.
    kinds = {(run.scene, run.densification, run.image_scale): run for run in reversed(runs)}
    short = [dataclasses.replace(run, steps=STEPS, marks=()) for run in kinds.values()]
    with tempfile.TemporaryDirectory(prefix="warm-up-", dir=place.folder) as folder:
        for shared in (place.scenes, place.artifacts):
            (Path(folder) / shared.name).symlink_to(shared.resolve())
        devices = [] if device is None else [device]
        runner = DaskRunner(ResultsFolder(Path(folder)), devices, 1, lambda run: "", False, None)
        runner.work(short, lambda run: None, deadline, lambda *_: None, lambda *_: None)
    return len(short)
