"""Runs tests on mutants, each in a fork of a process that has imported them.

`python -m benchmarks.mutation.trials PYTEST-ARGUMENTS` reads trials, one JSON object a line, and answers each.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import IO

import pytest
from mutmut.mutation.trampoline import set_mutant_under_test

TIMEOUT = 36
"""mutmut's exit code of a mutant that ran out of time."""
OPTIONS = ("-x", "-q", "--tb=short", "-p", "no:cacheprovider", "-o", "tmp_path_retention_policy=none")


class Chosen:
    """Runs some tests alone, in the order in which they are given, and notes which one runs."""

    def __init__(self, tests: list[str], note: Path) -> None:
        """Choose tests by their node ids."""
        self._place = {name: place for place, name in enumerate(tests)}
        self._note = note

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Drop the others."""
        items[:] = sorted((item for item in items if item.nodeid in self._place), key=lambda i: self._place[i.nodeid])

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Note which test runs, for one that ends the process."""
        self._note.write_text(nodeid)


def _try(mutant: str, tests: list[str], seconds: float, log: IO[str]) -> tuple[int, str]:
    """The exit code of pytest, and the test that ran last."""
    with tempfile.TemporaryDirectory() as folder:
        note = Path(folder) / "running"
        if not (child := os.fork()):
            os.setpgid(0, 0)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)  # the trials are there
            for stream in (1, 2):
                os.dup2(log.fileno(), stream)
            set_mutant_under_test(mutant)
            files = sorted({name.partition("::")[0] for name in tests})
            os._exit(pytest.main([*OPTIONS, *files], plugins=[Chosen(tests, note)]))
        code = _waited(child, seconds)
        with contextlib.suppress(ProcessLookupError):  # what its tests started
            os.killpg(child, signal.SIGKILL)
        return code, note.read_text() if note.exists() else ""


def _waited(child: int, seconds: float) -> int:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return TIMEOUT


def main(*arguments: str) -> None:
    """Import the tests, and answer until the input ends."""
    answers = os.fdopen(os.dup(1), "w")
    with open("trials.log", "w") as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
        pytest.main(["--collect-only", "-qqq", "-p", "no:cacheprovider", *arguments])
        for line in sys.stdin:
            code, last = _try(log=log, **json.loads(line))
            print(json.dumps([code, last]), file=answers, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
