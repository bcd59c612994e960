"""One process at a time in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ssa_nerfstudio.errors import InputError

LOCK = ".lock"
"""Name of the lock file in the folder. The operating system releases the lock however the process ends."""


@contextmanager
def locked_folder(folder: Path, command: str) -> Iterator[None]:
    """Make a folder and lock out other processes that ask for it until the block ends.

    Args:
        folder: the folder to work in; made where missing.
        command: name of the command for messages, such as `ssa bench`.

    Raises:
        InputError: another process holds the lock, or the folder cannot be written.
    """
    lock = FileLock(folder / LOCK)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(blocking=False)
    except Timeout as error:
        raise InputError(
            f"another {command} is at work in {folder}", "wait until it ends, or choose another output folder"
        ) from error
    except OSError as error:
        raise InputError(
            f"{folder} cannot be written ({error})", "free space there or choose another output folder"
        ) from error
    try:
        yield
    finally:
        lock.release()
