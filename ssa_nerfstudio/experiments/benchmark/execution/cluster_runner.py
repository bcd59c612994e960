"""Runs on a dask.distributed cluster: a task each, one at a time on a worker; scheduling is all dask's."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.execution.local_runner import Worker, finish
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import Workplace
from ssa_nerfstudio.experiments.benchmark.execution.run_process import Request
from ssa_nerfstudio.experiments.benchmark.results import Result
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run

CONNECT_SECONDS = 30


@dataclass
class Cluster:
    """The tasks of a benchmark on a cluster whose workers see the output folder under the same path."""

    place: Workplace
    address: str
    """Of the scheduler, for example tcp://host:8786."""
    runs_per_device: int
    """Tasks that a worker may have at a time; a worker stands for a device."""
    command: Callable[[Run], str]
    keep_models: bool = False

    def work(
        self,
        runs: list[Run],
        deadline: float | None,
        watch: Callable[[int, int], None],
        ended: Callable[[Run, Result | None], None],
    ) -> list[Run]:
        """Hands the runs to the cluster in their order.

        Args:
            runs: what to do.
            deadline: `time.monotonic()` at which what has not ended is cancelled; None: never.
            watch: called every second with how many tasks run and how many wait.
            ended: called for every run that ended, with its result, None where it left none.

        Returns:
            The runs that were not done for lack of time.

        Raises:
            InputError: dask is not installed, or no scheduler answers.
        """
        try:
            from distributed import Client
        except ImportError as error:
            raise InputError("--scheduler needs dask", "pip install 'ssa-nerfstudio[cluster]'") from error
        try:
            client = Client(self.address, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise InputError(
                f"no dask scheduler answers at {self.address} ({error})", "start one with `dask scheduler`"
            ) from error
        with client:
            futures: dict[Any, Run] = {}
            for priority, run in enumerate(runs):
                request = Request(
                    run, str(self.place.folder.resolve()), self.runs_per_device, self.command(run), self.keep_models
                )
                # Workers divide their threads among tasks by this; the number of runs at once is theirs to say.
                future = client.submit(_task, request, key=run.id, priority=-priority, pure=False, retries=0)
                futures[future] = run
            while futures:
                for future in [f for f in futures if f.status in ("finished", "error", "cancelled", "lost")]:
                    ended(futures.pop(future), future.result() if future.status == "finished" else None)
                processing = cast(dict[str, tuple], client.processing())
                running = sum(len(tasks) for tasks in processing.values())
                watch(min(running, len(futures)), max(0, len(futures) - running))
                if deadline is not None and time.monotonic() > deadline:
                    left = list(futures.values())
                    client.cancel(list(futures), force=True)
                    return left
                if futures:
                    time.sleep(1.0)
        return []


def _task(request: Request) -> Result | None:
    """One run, in a process of its own on the worker's machine."""
    place = Workplace(Path(request.folder))
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    with Worker(place, visible.split(",")[0] if visible else None).start(request) as process:
        process.wait()
    return finish(place, request.run)
