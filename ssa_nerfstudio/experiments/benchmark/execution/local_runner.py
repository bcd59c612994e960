"""Runs on this machine: a process each, one a device unless asked otherwise, until done or out of time."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from uuid import uuid4

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import Workplace
from ssa_nerfstudio.experiments.benchmark.execution.run_process import PROGRESS, REQUEST, Request
from ssa_nerfstudio.experiments.benchmark.results import Result, read
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run

POLL = 0.2
"""Seconds between looks at the processes."""
FLIP_PROCESSES = 16
"""At most so many compare the views of one run, on a core each."""
PATIENCE = 10.0
"""Seconds that a process asked to end has before it is killed."""


@dataclass
class Process:
    """A run at work."""

    run: Run
    device: str | None
    """CUDA device; None: the CPU."""
    popen: subprocess.Popen
    started: float
    progress: Path

    def state(self) -> tuple[str, int]:
        """What it does, and how many training steps are done."""
        with contextlib.suppress(OSError, ValueError):
            stage, steps = self.progress.read_text().split()
            return stage, int(steps)
        return "starting", 0


@dataclass
class Local:
    """The processes of a benchmark on this machine."""

    place: Workplace
    devices: list[str]
    """CUDA devices; empty: the CPU."""
    runs_per_device: int
    command: Callable[[Run], str]
    """What repeats a run."""
    keep_models: bool = False
    processes: list[Process] = field(default_factory=list)
    _ready: dict[str, Worker] = field(default_factory=dict)
    """By CUDA device: a process that waits for the next run there."""

    def work(
        self,
        runs: list[Run],
        estimate: Callable[[Run], float | None],
        deadline: float | None,
        watch: Callable[[list[Process], list[Run]], None],
        ended: Callable[[Run, Result | None], None],
    ) -> list[Run]:
        """Runs them in their order.

        Args:
            runs: what to do.
            estimate: seconds that a run will take; None: unknown.
            deadline: `time.monotonic()` by which all has to be over; None: never.
            watch: called several times a second with the processes and with what waits.
            ended: called for every run that ended, with its result, None where it left none.

        Returns:
            The runs that were not done for lack of time.
        """
        waiting, left = list(runs), []
        slots: list[str | None] = [*(self.devices or [None])] * self.runs_per_device
        try:
            while waiting or self.processes:
                for process in [p for p in self.processes if p.popen.poll() is not None]:
                    self.processes.remove(process)
                    process.popen.communicate()  # closes the pipe
                    slots.append(process.device)
                    ended(process.run, self._result(process.run))
                if deadline is not None and time.monotonic() > deadline:
                    left += [process.run for process in self.processes] + waiting
                    waiting = []
                    self.stop()
                while slots and waiting:
                    run = waiting.pop(0)
                    if deadline is not None and (estimate(run) or 0.0) > deadline - time.monotonic():
                        left.append(run)
                        continue
                    device = slots.pop(0)
                    self.processes.append(self._start(run, device))
                    if waiting:
                        self._make_ready(device)
                watch(self.processes, waiting)
                if self.processes:
                    time.sleep(POLL)
        finally:
            self.stop()
        return left

    def stop(self) -> None:
        """End what is running; such runs start anew next time."""
        for process in self.processes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.popen.pid, signal.SIGTERM)
        for process in self.processes:
            try:
                process.popen.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.popen.pid, signal.SIGKILL)
            process.popen.communicate()
        self.processes.clear()
        for worker in self._ready.values():
            worker.dismiss()
        self._ready.clear()

    def _start(self, run: Run, device: str | None) -> Process:
        """Starts a run; on a GPU with a process that has imported everything while the run before was at work."""
        request = Request(
            run,
            str(self.place.folder),
            self.runs_per_device,
            self.command(run),
            self.keep_models,
            self._flip_processes(),
        )
        worker = self._ready.pop(device, None) if device is not None else None
        if worker is not None and not worker.waits():  # it was killed
            worker.dismiss()
            worker = None
        popen = (worker or Worker(self.place, device)).start(request)
        return Process(run, device, popen, time.monotonic(), self.place.running(run.id) / PROGRESS)

    def _make_ready(self, device: str | None) -> None:
        """Has a process wait for the next run on a GPU; on the CPU it would take a core from the run."""
        if device is not None and device not in self._ready:
            with contextlib.suppress(OSError):  # then the next run begins with its imports
                self._ready[device] = Worker(self.place, device)

    def _flip_processes(self) -> int:
        """What the cores allow; 1 without a GPU, where a view takes longer to render than to compare."""
        at_once = len(self.devices) * self.runs_per_device
        return max(1, min(FLIP_PROCESSES, (os.cpu_count() or 1) // at_once)) if at_once else 1

    def _result(self, run: Run) -> Result | None:
        return finish(self.place, run)


class Worker:
    """A process that imports what training takes, touches no device, and waits for the run that it will do."""

    def __init__(self, place: Workplace, device: str | None) -> None:
        """Start it.

        Args:
            place: where it will work.
            device: the only CUDA device that it will see; None: all of this process's.
        """
        self._place = place
        place.unfinished.mkdir(parents=True, exist_ok=True)
        self._log = place.unfinished / f"{uuid4().hex}.log"
        with self._log.open("w") as output:
            self._popen = subprocess.Popen(
                [sys.executable, "-m", "ssa_nerfstudio.experiments.benchmark.execution.run_process", str(place.folder)],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=os.environ if device is None else {**os.environ, "CUDA_VISIBLE_DEVICES": device},
                start_new_session=True,
            )

    def waits(self) -> bool:
        """Whether it is still there."""
        return self._popen.poll() is None

    def start(self, request: Request) -> subprocess.Popen:
        """Have the run done, in a process group of its own, with its log beside the results.

        It ends early where the process's standard input is closed.
        """
        running, log = self._place.running(request.run.id), self._place.log(request.run.id)
        running.mkdir(parents=True, exist_ok=True)
        log.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # somebody cleared the folder
            self._log.rename(log)  # also where it is being written to
        replace(request, asked=time.time()).store(running / REQUEST)
        assert self._popen.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it was killed, and leaves no result
            self._popen.stdin.write(f"{request.run.id}\n".encode())
            self._popen.stdin.flush()
        return self._popen

    def dismiss(self) -> None:
        """End it; it has nothing to lose."""
        self._popen.kill()
        self._popen.communicate()
        self._log.unlink(missing_ok=True)


def finish(place: Workplace, run: Run) -> Result | None:
    """Clears up behind a process that ended; its result, None where it left none."""
    import shutil

    shutil.rmtree(place.running(run.id), ignore_errors=True)
    try:
        return read(place.result(run.id))
    except InputError:
        return None
