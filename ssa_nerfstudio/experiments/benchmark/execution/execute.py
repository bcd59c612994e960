"""A benchmark from plan to results: prepare, skip what is done, run the rest, say what is left."""

from __future__ import annotations

import shlex
import statistics
import time
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from rich.console import Console

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.execution.dask_runner import DaskRunner
from ssa_nerfstudio.experiments.benchmark.execution.datasets import check_captures, prepare
from ssa_nerfstudio.experiments.benchmark.execution.progress_table import ProgressTable
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import ResultsFolder
from ssa_nerfstudio.experiments.benchmark.execution.run_process import configuration
from ssa_nerfstudio.experiments.benchmark.execution.warm_up import warm_up
from ssa_nerfstudio.experiments.benchmark.results import Result, adopt, read_all
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run
from ssa_nerfstudio.experiments.runs.machine import devices


@dataclass(frozen=True)
class Options:
    """How to run, apart from what."""

    threads: int
    """Photos worked on at once while datasets are made."""
    runs_per_device: int = 1
    time_limit: float | None = None
    """Minutes after which no run is at work any more."""
    scheduler: str | None = None
    """Address of a dask.distributed scheduler."""
    keep_models: bool = False
    compile_first: bool = False
    """Compile kernels before the first run's clock; not on a cluster, nor where runs share a device."""


def select(runs: list[Run], scenes: tuple[str, ...], only: tuple[str, ...]) -> list[Run]:
    """The runs of some scenes, whose ids match a pattern.

    Args:
        scenes: names; empty: all.
        only: shell patterns for ids; empty: all.

    Raises:
        InputError: nothing is left.
    """
    known = sorted({run.scene for run in runs})
    for name in scenes:
        if name not in known:
            raise InputError(f"the benchmark has no scene {name!r}", f"choose from {', '.join(known)}")
    chosen = [run for run in runs if not scenes or run.scene in scenes]
    chosen = [run for run in chosen if not only or any(fnmatchcase(run.id, pattern) for pattern in only)]
    if not chosen:
        raise InputError(f"no run's id matches {' '.join(only)}", "list the ids of the runs first")
    return chosen


def bench(runs: list[Run], place: ResultsFolder, invocation: str, options: Options, console: Console) -> list[Run]:
    """Brings the results folder up to date with the runs.

    Args:
        runs: in the order of their importance.
        place: the output folder; locked by the caller.
        invocation: `ssa bench NAME` or `ssa tradeoff NAME`, for the commands that results keep.
        options: how to run.
        console: progress goes there.

    Returns:
        The runs that were not done for lack of time.

    Raises:
        InputError: a dataset cannot be made.
    """
    began = time.monotonic()
    deadline = None if options.time_limit is None else began + 60 * options.time_limit
    results, problems = read_all([place.folder])
    for problem in problems:
        console.print(f"ignored: {problem}", style="yellow", highlight=False, soft_wrap=True)
    names, known = _outstanding(runs, results)
    todo = _untrained(names, known)
    prepare(todo, place.scenes, place.artifacts, options.threads, console)

    def command(run: Run) -> str:
        return f"{invocation} --output {shlex.quote(str(place.folder))} --only {shlex.quote(run.id)}"

    found = devices()
    if todo and options.compile_first and options.scheduler is None and options.runs_per_device == 1:
        with console.status("Compiling kernels, in short trainings that are not timed ..."):
            warm_up(todo, place, found[0] if found else None, deadline)
    at_once = max(1, len(found)) * options.runs_per_device
    done = len(runs) - sum(len(same) for same in names.values())
    with ProgressTable(console, len(runs), done, at_once) as table:
        estimate = RuntimeEstimate(results)

        def ended(run: Run, result: Result | None) -> None:
            table.ended(run, result)
            trained = result if result is not None and result.status != "failed" else None
            if trained is not None:
                estimate.add(trained)
            for other in names[run.training][1:]:
                table.ended(other, result if trained is None else adopt(trained, other, place.folder))

        for training, same in names.items():
            for run in same if training in known else ():
                table.ended(run, adopt(known[training], run, place.folder))
        runner = DaskRunner(place, found, options.runs_per_device, command, options.keep_models, options.scheduler)
        left = runner.work(todo, estimate.seconds, deadline, table.watch, ended)
    return [same for run in left for same in names[run.training]]


def check(runs: list[Run], place: ResultsFolder, merged: tuple[Path, ...] = ()) -> None:
    """Check what is to be trained, before anything is written.

    Args:
        runs: as `bench` takes them.
        place: the output folder.
        merged: further folders whose results count.

    Raises:
        InputError: a run has a setting that its model has not, or its capture is missing or cannot be used.
        ModuleNotFoundError: the runs' scheduler is not installed.
    """
    import distributed  # noqa: F401 - by the runner, after minutes of making datasets

    todo = _untrained(*_outstanding(runs, read_all([place.folder, *merged])[0]))
    for run in todo:
        _check_settings(run, place)
    check_captures(todo, place.scenes, place.artifacts)


def _outstanding(runs: list[Run], results: list[Result]) -> tuple[dict[str, list[Run]], dict[str, Result]]:
    """Runs without a result, by their training and in the order of their importance; and a result of each training."""
    there = [result for result in results if result.status != "failed"]
    done, known = {result.run.id for result in there}, {result.run.training: result for result in there}
    names: dict[str, list[Run]] = {}
    for run in runs:
        if run.id not in done:
            names.setdefault(run.training, []).append(run)
    return names, known


def _untrained(names: dict[str, list[Run]], known: dict[str, Result]) -> list[Run]:
    """Of each training that has no result, the most important run."""
    return [same[0] for training, same in names.items() if training not in known]


def _check_settings(run: Run, place: ResultsFolder) -> None:
    """Build a run's configuration now, so that a misspelt setting is not found after hours of other runs."""
    try:
        configuration(run, place)
    except InputError as error:
        raise InputError(f"{run.id}: {error.problem}", error.remedy) from error


class RuntimeEstimate:
    """Seconds that a run will take, estimated from finished runs."""

    def __init__(self, results: list[Result]) -> None:
        """Start from the results of earlier calls."""
        self._fixed: dict[str, list[float]] = {}
        self._per_step: dict[tuple[str, str], list[float]] = {}
        for result in results:
            self.add(result)

    def add(self, result: Result) -> None:
        """Add a result."""
        if result.status != "finished":
            return
        run, training = result.run, result.seconds["training"]
        self._fixed.setdefault(run.scene, []).append(result.total_seconds - training)
        self._per_step.setdefault((run.scene, run.densification), []).append(training / run.steps)

    def seconds(self, run: Run) -> float | None:
        """Seconds that a run will take; None where nothing like it has ended yet.

        Median seconds a step and median of all else, of the same scene and densification, else of the slowest.
        """
        if not self._per_step:
            return None
        fixed = self._fixed.get(run.scene) or max(self._fixed.values(), key=statistics.median)
        steps = self._per_step.get((run.scene, run.densification))
        steps = steps or max(self._per_step.values(), key=statistics.median)
        return statistics.median(fixed) + run.steps * statistics.median(steps)


def reach(folder: Path) -> ResultsFolder:
    """The workplace of an output folder.

    Raises:
        InputError: the path is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file", "choose another output folder")
    return ResultsFolder(folder)
