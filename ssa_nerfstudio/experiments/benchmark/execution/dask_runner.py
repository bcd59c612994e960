"""Many runs through dask: on this machine with a worker for each device, or on a cluster."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import ResultsFolder
from ssa_nerfstudio.experiments.benchmark.execution.run_process import Request
from ssa_nerfstudio.experiments.benchmark.execution.worker_task import PATIENCE, POLL, dismiss_prepared, perform
from ssa_nerfstudio.experiments.benchmark.results import Result
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run

if TYPE_CHECKING:
    from distributed import Client, SpecCluster

CONNECT_SECONDS = 30
FLIP_PROCESSES = 16
"""At most so many compare the views of one run, on a core each."""


@dataclass
class DaskRunner:
    """The runs of a benchmark as tasks of dask, one at a time on a worker."""

    folder: ResultsFolder
    """On a cluster the workers must see it under the same path."""
    devices: list[str]
    """CUDA devices of this machine; empty: the CPU."""
    runs_per_device: int
    """Runs that share a device at a time."""
    command: Callable[[Run], str]
    """What repeats a run."""
    keep_models: bool = False
    scheduler: str | None = None
    """Address of a cluster's scheduler, for example tcp://host:8786; None: this machine."""

    def work(
        self,
        runs: list[Run],
        estimate: Callable[[Run], float | None],
        deadline: float | None,
        watch: Callable[[list[Request], int], None],
        ended: Callable[[Run, Result | None], None],
    ) -> list[Run]:
        """Work through the runs in their order.

        Args:
            runs: what to do.
            estimate: seconds that a run will take; None: unknown.
            deadline: `time.monotonic()` by which all has to be over; None: never.
            watch: called several times a second with the requests at work and the number of runs that wait.
            ended: called for every run that ended, with its result, None where it left none.

        Returns:
            The runs that were not done for lack of time.

        Raises:
            InputError: no scheduler answers.
        """

        def remaining() -> float:
            return math.inf if deadline is None else deadline - time.monotonic()

        left = [run for run in runs if (estimate(run) or 0.0) > remaining()]
        todo = [run for run in runs if run not in left]
        if not todo:
            return left
        with self._client() as client:
            futures: dict[Any, Run] = {}
            try:
                while (todo or futures) and remaining() > 0:
                    for future in [f for f in futures if f.status in ("finished", "error", "cancelled", "lost")]:
                        ended(futures.pop(future), future.result() if future.status == "finished" else None)
                    # No more than the workers take at once: what a scheduler holds it hands out in an order of its own.
                    while todo and len(futures) < _slots(client):
                        run = todo.pop(0)
                        if (estimate(run) or 0.0) > remaining():
                            left.append(run)
                            continue
                        task = self._request(run), self._prepares() and bool(todo)
                        futures[client.submit(perform, *task, key=run.id, pure=False, retries=0)] = run
                    requests = [request for run in futures.values() if (request := self._at_work(run)) is not None]
                    watch(requests, len(todo) + len(futures) - len(requests))
                    time.sleep(POLL)
                return sorted([*left, *futures.values(), *todo], key=runs.index)
            finally:
                self._stop(client, futures)

    def _stop(self, client: Client, futures: dict) -> None:
        """End what is at work; such runs start anew next time."""
        from distributed import wait

        begun = [future for future, run in futures.items() if self.folder.request(run.id).exists()]
        client.cancel([future for future in futures if future not in begun])
        for future in begun:
            self.folder.request(futures[future].id).unlink(missing_ok=True)
        with suppress(TimeoutError):
            wait(begun, timeout=PATIENCE + 5)
        client.run(dismiss_prepared)

    def _request(self, run: Run) -> Request:
        folder = str(self.folder.folder.resolve())
        flips = self._flip_processes()
        return Request(run, folder, self.runs_per_device, self.command(run), self.keep_models, flips)

    def _at_work(self, run: Run) -> Request | None:
        try:
            return Request.load(self.folder.request(run.id))
        except InputError:
            return None

    def _prepares(self) -> bool:
        """On the CPU the imports of the next run would take a core from the one at work."""
        return self.scheduler is None and bool(self.devices)

    def _flip_processes(self) -> int:
        """What the cores allow; 1 without a GPU, where a view takes longer to render than to compare."""
        at_once = len(self.devices) * self.runs_per_device if self.scheduler is None else 0
        return max(1, min(FLIP_PROCESSES, usable_cores() // at_once)) if at_once else 1

    @contextmanager
    def _client(self) -> Iterator[Client]:
        from distributed import Client

        if self.scheduler is None:
            with (
                _local_cluster([*(self.devices or [None])] * self.runs_per_device) as cluster,
                Client(cluster) as client,
            ):
                yield client
            return
        try:
            client = Client(self.scheduler, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            problem = f"no dask scheduler answers at {self.scheduler} ({error})"
            raise InputError(problem, "start one with `dask scheduler`") from error
        with client:
            yield client


def _slots(client: Client) -> int:
    """Tasks that the workers do at a time."""
    return sum(client.nthreads().values())  # pyright: ignore[reportAttributeAccessIssue] (typed as asynchronous)


@contextmanager
def _local_cluster(devices: list[str | None]) -> Iterator[SpecCluster]:
    """A worker process for each CUDA device (None: the CPU); all of them end with this process, whatever ends it."""
    from dask import config
    from distributed import Nanny, Scheduler, SpecCluster
    from distributed.security import Security

    settings = {
        "distributed.nanny.pre-spawn-environ": {},  # would restrict the trainings to one thread
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
    }
    # Without TLS, other users of this machine could send tasks to the scheduler's port.
    security = Security.temporary()
    shared = {"host": "127.0.0.1", "port": 0, "dashboard_address": "127.0.0.1:0", "security": security}
    quiet: Any = logging.CRITICAL
    worker = {**shared, "nthreads": 1, "memory_limit": 0, "silence_logs": quiet}
    workers = {
        number: {"cls": Nanny, "options": {**worker, "env": {"CUDA_VISIBLE_DEVICES": device} if device else {}}}
        for number, device in enumerate(devices)
    }
    scheduler = {"cls": Scheduler, "options": shared}
    # Workers inherit that ctrl+c is ignored: it is this process that stops them.
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with config.set(settings):
            cluster = SpecCluster(workers, scheduler, security=security, silence_logs=quiet)
    finally:
        signal.signal(signal.SIGINT, handler)
    with cluster:
        yield cluster
