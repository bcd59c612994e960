"""Processes that end with the one that started them: nobody would wait for what a killed command has begun."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable

POLL = 0.5
"""Seconds between looks at who the parent is."""


def end_after(wait: Callable[[], object]) -> None:
    """End this process, whatever it does, as soon as `wait()` returns in a thread of its own."""

    def watch() -> None:
        wait()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def end_with_parent() -> None:
    """Watch the parent from now on, for processes that share nothing else with it."""
    parent = os.getppid()

    def wait() -> None:
        while os.getppid() == parent:
            time.sleep(POLL)

    end_after(wait)
