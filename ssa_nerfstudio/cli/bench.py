"""`ssa bench`."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ssa_nerfstudio._system import ctrl_c
from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.terminal_messages import plain_console
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.errors import InputError, TrainingError

if TYPE_CHECKING:
    from ssa_nerfstudio.experiments.benchmark.results import Result
    from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Benchmark
    from ssa_nerfstudio.experiments.benchmark.specification.plan import Run


@dataclass
class Command:
    """Train and score scenes x effects x methods x seeds; go on where an earlier call stopped."""

    output: Path
    """Folder of the results; an earlier one is brought up to date, a finished run is never repeated."""
    benchmark: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="BENCHMARK")] = "smoke"
    """smoke, captures, captures-cpu, games, games-cpu, baselines, exposure, exposure-captures, gaussian-counts,
    lengths, photo-scales, mipnerf360, two-pass, or a .yaml file."""
    scenes: tuple[str, ...] = ()
    """Only these scenes."""
    only: tuple[str, ...] = ()
    """Only runs whose ids match one of these shell patterns, for example '*-rain-*' (--list shows the ids)."""
    time_limit: float | None = None
    """Minutes: no run is started that would not end in time, what still runs then is stopped, and what is left is
    said. Call again to go on."""
    runs_per_device: Count = 1
    """Runs that share a GPU (or the CPU) at a time; above 1 their seconds count for no frontier."""
    scheduler: str | None = None
    """Address of a dask.distributed scheduler; its workers must see --output under the same path."""
    prepare_only: bool = False
    """Make the datasets and drawn effects, and stop: for machines that cannot draw them."""
    merge: tuple[Path, ...] = ()
    """Copy the results of these folders first."""
    keep_models: bool = False
    """Keep config.yml and checkpoint of every training that this call does in models/, for ns-viewer and ns-export."""
    list: bool = False
    """Print the ids of the runs, and which are done, and stop."""
    threads: Count = field(default_factory=usable_cores)
    """Photos worked on at once while datasets are made."""

    def run(self) -> None:
        """Bring the folder up to date.

        Raises:
            InputError: the arguments, the benchmark or a capture cannot be worked with.
            TrainingError: runs failed.
        """
        from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import read_benchmark
        from ssa_nerfstudio.experiments.benchmark.specification.plan import plan

        benchmark = read_benchmark(self.benchmark)
        runs = plan(benchmark)
        if not runs:
            raise InputError(f"{self.benchmark} states no parts", f"`ssa tradeoff {self.benchmark}` may be meant")
        left, failed = update(self, "bench", benchmark, runs)
        require_none(failed)
        if not (left or self.prepare_only or self.list):
            print(f"All {self.benchmark} runs that were requested are done: ssa report {shlex.quote(str(self.output))}")


def update(command: Command, name: str, benchmark: Benchmark, planned: list[Run]) -> tuple[list[Run], list[Result]]:
    """What bench and tradeoff share: brings the folder up to date with the runs; those that are left, or failed."""

    from ssa_nerfstudio.experiments.benchmark.execution import execute as bench
    from ssa_nerfstudio.experiments.benchmark.execution.datasets import check_captures, prepare
    from ssa_nerfstudio.experiments.benchmark.report.benchmark_report import store_plan
    from ssa_nerfstudio.experiments.benchmark.results import Result, merge, read_all

    if command.time_limit is not None and not 0 < command.time_limit < math.inf:
        raise InputError(f"--time-limit must be a positive number of minutes, got {command.time_limit:g}")
    runs = bench.select(planned, command.scenes, command.only)
    place = bench.reach(command.output)
    console = plain_console()
    for folder in command.merge:
        if not (folder / "results").is_dir():
            raise InputError(f"--merge {folder} holds no results", "name the --output folder of another ssa bench")
    if command.list:
        done = {result.run.id: result.status for result in read_all([command.output, *command.merge])[0]}
        for run in runs:
            print(f"{done.get(run.id, 'to do'):<9} {run.id}")
        return [], []
    if command.prepare_only:
        check_captures(runs, place.scenes, place.artifacts)
    else:
        bench.check(runs, place, command.merge)
    with place.locked(), _continued(command.output):
        for folder in command.merge:
            console.print(f"{counted(merge(folder, command.output), 'result')} taken over from {folder}")
        store_plan(command.output, name, benchmark, planned)
        if command.prepare_only:
            prepare(runs, place.scenes, place.artifacts, command.threads, console)
            console.print(f"{counted(len({run.dataset for run in runs}), 'dataset')} ready in {place.scenes}")
            return [], []
        options = bench.Options(
            command.threads,
            command.runs_per_device,
            command.time_limit,
            command.scheduler,
            command.keep_models,
            compile_first=name == "tradeoff",
        )
        left = bench.bench(runs, place, f"ssa {name} {command.benchmark}", options, console)
    if left:
        console.print(
            f"Left: {len(left)} of {counted(len(runs), 'run')}; call the same again to go on. First: {left[0].id}"
        )
    results = {result.run.id: result for result in read_all([command.output])[0]}
    ended = [results.get(run.id) or Result(run, "failed", "it left no result") for run in runs if run not in left]
    return left, [result for result in ended if result.status == "failed"]


@contextmanager
def _continued(output: Path) -> Iterator[None]:
    """Say of a benchmark that is stopped that the same command goes on with it."""
    try:
        with ctrl_c.unwrapped():
            yield
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(f"stopped; the same command continues in {output}") from interrupt


def require_none(failed: list[Result]) -> None:
    """Let a command end with an error where runs failed.

    Raises:
        TrainingError: there are failed runs.
    """
    if failed:
        raise TrainingError(
            f"{counted(len(failed), 'run')} failed, first {failed[0].run.id}: {failed[0].reason}",
            "see its log; call the same again to repeat them",
        )
