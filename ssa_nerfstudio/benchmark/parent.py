"""Processes that end with the one that started them."""

from __future__ import annotations

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
    """End with the parent, and work on one core: to be called before OpenMP is loaded, which reads it then."""
    os.environ["OMP_NUM_THREADS"] = "1"
    end_with_parent()
