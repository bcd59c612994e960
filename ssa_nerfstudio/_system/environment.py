"""What a process is started in, where libraries end it without a reason, or with a traceback."""

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


def check_working_directory() -> None:
    """Check the directory that relative paths begin at, before the libraries are imported.

    Raises:
        InputError: it was deleted, or its path is longer than the system opens.
    """
    try:
        os.stat(os.getcwd())
    except OSError as error:
        raise InputError(f"the working directory cannot be used ({error.strerror})", "change to another") from error
