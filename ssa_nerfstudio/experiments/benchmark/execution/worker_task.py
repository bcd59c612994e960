"""A run as a task of a dask worker, in a process of its own."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import ResultsFolder
from ssa_nerfstudio.experiments.benchmark.execution.run_process import Request
from ssa_nerfstudio.experiments.benchmark.results import Result, read

POLL = 0.2
"""Seconds between two checks of a process."""
PATIENCE = 10.0
"""Seconds that a process asked to end has before it is killed."""
_prepared: RunProcess | None = None
"""In a dask worker: a process that waits for the worker's next run."""


def perform(request: Request, prepare_next: bool) -> Result | None:
    """Do a run; it is stopped when its request is removed from the results folder.

    Args:
        request: what to do.
        prepare_next: start the process of the next run, so that it imports while this run is at work.

    Returns:
        The result; None where the run left none.
    """
    global _prepared
    folder, run = ResultsFolder(Path(request.folder)), request.run
    process, _prepared = _prepared, None
    if process is not None and not process.alive():  # it was killed
        process.dismiss()
        process = None
    process = process or RunProcess(folder)
    process.start(request)
    if prepare_next:
        with contextlib.suppress(OSError):  # then the next run begins with its imports
            _prepared = RunProcess(folder)
    while process.alive():
        time.sleep(POLL)
        if not folder.request(run.id).exists():
            process.stop()
    process.close()
    shutil.rmtree(folder.running(run.id), ignore_errors=True)
    try:
        return read(folder.result(run.id))
    except InputError:
        return None


def dismiss_prepared() -> None:
    """End the process that waits for a run, if there is one."""
    global _prepared
    process, _prepared = _prepared, None
    if process is not None:
        process.dismiss()


class RunProcess:
    """A process that imports what training takes, touches no device, and waits for the run that it will do."""

    def __init__(self, folder: ResultsFolder) -> None:
        """Start it; it sees the first CUDA device of this process alone."""
        self._folder = folder
        folder.unfinished.mkdir(parents=True, exist_ok=True)
        self._log = folder.unfinished / f"{uuid4().hex}.log"
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        self._device = visible.split(",")[0] if visible else None
        module = "ssa_nerfstudio.experiments.benchmark.execution.run_process"
        with self._log.open("w") as output:
            self._popen = subprocess.Popen(
                [sys.executable, "-m", module, str(folder.folder)],
                stdin=subprocess.PIPE,  # the process ends when it is closed, whatever ends this one
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "CUDA_VISIBLE_DEVICES": self._device} if self._device else None,
                start_new_session=True,
            )

    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._popen.poll() is None

    def start(self, request: Request) -> None:
        """Have the run done, with its log beside the results."""
        run = request.run.id
        self._folder.running(run).mkdir(parents=True, exist_ok=True)
        self._folder.log(run).parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # the folder was cleared
            self._log.rename(self._folder.log(run))  # also where it is being written to
        replace(request, asked=time.time(), device=self._device).store(self._folder.request(run))
        assert self._popen.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it was killed, and leaves no result
            self._popen.stdin.write(f"{run}\n".encode())
            self._popen.stdin.flush()

    def stop(self) -> None:
        """End it with all that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._popen.pid, signal.SIGTERM)
            try:
                self._popen.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(self._popen.pid, signal.SIGKILL)

    def dismiss(self) -> None:
        """End it before it was given a run."""
        self._popen.kill()
        self.close()
        self._log.unlink(missing_ok=True)

    def close(self) -> None:
        """Wait for its end and close its pipe."""
        self._popen.communicate()
