"""One process at a time in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ssa_nerfstudio.errors import InputError

LOCK = ".lock"
"""Its file in the folder; the system lets go of it when the process ends, whatever ends it."""


@contextmanager
def held(folder: Path, command: str) -> Iterator[None]:
    """Makes the folder and keeps every other process that asks for it out until the block ends.

    Args:
        folder: to work in.
        command: what the message calls the one that is there already: `ssa bench`.

    Raises:
        InputError: another process holds it, or it cannot be written.
    """
    lock = FileLock(folder / LOCK)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(blocking=False)
    except Timeout as error:
        raise InputError(
            f"another {command} is at work in {folder}", "wait for it, or name another --output"
        ) from error
    except OSError as error:
        raise InputError(
            f"{folder} cannot be written ({error})", "free space there or name another --output"
        ) from error
    try:
        yield
    finally:
        lock.release()
