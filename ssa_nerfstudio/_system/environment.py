"""Environment variables that libraries end with a traceback at."""

from __future__ import annotations

import os

from ssa_nerfstudio.errors import InputError


def check_environment() -> None:
    """Check the variables, before the libraries are imported.

    Raises:
        InputError: NUMBA_NUM_THREADS is no number of threads.
    """
    threads = os.environ.get("NUMBA_NUM_THREADS") or "1"
    if not threads.isdecimal() or int(threads) < 1:
        raise InputError(f"NUMBA_NUM_THREADS is {threads!r}, no number of threads", "unset it, or set it to 1 or more")
