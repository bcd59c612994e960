"""Named pipes, which stand where a file is expected."""

from __future__ import annotations

from pathlib import Path


def refuse_pipe(path: Path) -> None:
    """Raise before a pipe is opened, which would wait forever for somebody to write into it.

    Raises:
        ValueError: it is one.
    """
    if path.is_fifo():
        raise ValueError("it is a pipe")
