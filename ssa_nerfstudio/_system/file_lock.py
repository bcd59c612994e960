"""One process at a time in a folder, or at a file."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ssa_nerfstudio._system.unwritable_output import unwritable
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
        raise unwritable(folder, error) from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def held(path: Path, wait: float = 0.0) -> Iterator[bool]:
    """Lock a file or folder itself, of which nothing is left when the process ends, however it does.

    Args:
        path: it exists.
        wait: seconds for another process that holds it.

    Yields:
        Whether it is locked; the file system may have no locks, and what may not be read cannot be locked.

    Raises:
        BlockingIOError: another process holds it, or has moved or removed it meanwhile.
        OSError: it cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:
        yield False
        return
    try:
        locked = _locked(descriptor, time.monotonic() + wait)
        if not (path.exists() and os.path.samestat(os.fstat(descriptor), path.stat())):
            raise BlockingIOError(f"{path} was moved by another process")
        yield locked
    finally:
        os.close(descriptor)


def _locked(descriptor: int, until: float) -> bool:
    """Lock a file by its descriptor, or say that the file system has no locks.

    Raises:
        BlockingIOError: another process holds it at that time of the monotonic clock.
    """
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= until:
                raise
            time.sleep(0.01)
        except OSError:
            return False
