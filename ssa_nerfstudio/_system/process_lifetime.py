"""Processes that end with the one that started them: nobody would wait for what a killed command has begun.

Imports nothing that starts threads, so that `be_one_of_many` comes before all that does.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import threading
from collections.abc import Callable


def end_after(wait: Callable[[], object]) -> None:
    """End this process, whatever it does, as soon as `wait()` returns in a thread of its own."""

    def watch() -> None:
        wait()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def end_with_parent() -> None:
    """For processes whose standard input is a pipe that the parent holds open: end when nobody does any more, also
    where the parent has ended already. What was written into the pipe stays there to be read."""
    hangup = select.poll()
    hangup.register(0, 0)
    end_after(hangup.poll)


def be_one_of_many() -> None:
    """In a process of `multiprocessing`: work on one core, and end with the parent, also where that has ended already.

    To be called before OpenMP and BLAS are loaded, which read their number of threads then.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_after(parent.join)
