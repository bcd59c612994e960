"""Child processes that end with their parent, also when the parent is killed.

Imports nothing that starts threads: `become_worker` has to run before anything that does.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import threading
from collections.abc import Callable


def end_with_parent() -> None:
    """End this process as soon as its parent has ended, even if that is already so.

    For processes whose standard input is a pipe that only the parent holds open. The pipe is watched for its end, not
    read.
    """
    hangup = select.poll()
    hangup.register(0, 0)
    _exit_after(hangup.poll)


def become_worker() -> None:
    """Prepare a process of `multiprocessing` for work on one core, ending with its parent.

    Call it before OpenMP and BLAS are loaded: they read their number of threads then.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    parent = multiprocessing.parent_process()
    assert parent is not None
    _exit_after(parent.join)


def _exit_after(wait: Callable[[], object]) -> None:
    """Exit at once when `wait()` returns in a thread of its own."""

    def watch() -> None:
        wait()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
