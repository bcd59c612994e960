"""Ctrl+c that arrives while a compiled function runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


def is_interrupt(error: BaseException) -> bool:
    """Whether an error is ctrl+c.

    A function of numba's returns its result all the same. CPython then raises SystemError ("returned a result with an
    exception set") with the interrupt as its cause; or as the cause of its cause, where each of two calls in each other
    does so.
    """
    source: BaseException | None = error
    while isinstance(source, SystemError):
        source = source.__cause__
    return isinstance(source, KeyboardInterrupt)


@contextmanager
def unwrapped() -> Iterator[None]:
    """Let every ctrl+c be KeyboardInterrupt."""
    try:
        yield
    except SystemError as error:
        if is_interrupt(error):
            raise KeyboardInterrupt from error
        raise
