"""Processes that end with the one that started them."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time


def end_with_parent() -> None:
    """Watch the parent from now on: what a killed benchmark has started, nobody would wait for."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def be_one_of_many() -> None:
    """In a process of `multiprocessing`: end with the parent, and work on one core.

    To be called before OpenMP is loaded, which reads its number of threads then.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()  # also where it has ended already
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
