"""The cores that this process may use."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Number of cores on which this process may run, at least 1; taskset or a cpuset may leave it fewer."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
