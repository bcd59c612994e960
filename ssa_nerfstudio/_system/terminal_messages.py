"""Errors and warnings as one line on the error stream: what commands show instead of tracebacks and log records."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, TypeVar

from ssa_nerfstudio.errors import InputError, SSAError, TrainingError, TrainingStopped

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")

INPUT_EXIT_CODE = 2
"""Of a command whose input cannot be used."""
TRAINING_EXIT_CODE = 3
"""Of a command whose training could not continue although its input was fine."""
INTERRUPTED_EXIT_CODE = 130
"""Of a command that ctrl+c ended, as shells have it."""


BROKEN_PIPE_EXIT_CODE = 141
"""Of a command whose output nobody reads any more, as shells have it."""


def plain_console(stderr: bool = False) -> Console:
    """A console for text that holds paths: `[x]` is no markup and `:x:` no emoji, and lines are not wrapped.

    Args:
        stderr: print to the error stream, where the output is for programs.
    """
    from rich.console import Console  # not before ctrl+c is handled

    class PlainConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # and not rich's exit with code 1

    return PlainConsole(stderr=stderr, highlight=False, soft_wrap=True, markup=False, emoji=False)


def photo_bar(photos: Iterable[T], total: int, console: Console) -> Iterable[T]:
    """A bar over photos that are worked on; none without a terminal, where a finished one leaves an empty line."""
    from rich.progress import track

    hidden = not console.is_terminal
    return track(photos, "Photos", total=total, console=console, transient=True, disable=hidden)


def refusal(error: BaseException) -> InputError | None:
    """What an error of the operating system says to a user: which file, and why. None where it does not say why."""
    if _of_memory(error):
        about = f" ({text})" if (text := " ".join(str(error).split(". ")[0].split())) else ""
        return InputError(f"memory ran out{about:.200}", "close other programs, or use smaller photos")
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop"):  # pathlib's, before Python 3.13
        return InputError(str(error), "name the folder itself")
    if not isinstance(error, OSError) or not error.strerror:
        return None
    name = os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else "the system refused a file"
    return InputError(f"{name}: {error.strerror}", "check the path, its permissions and the room on its disk")


def _of_memory(error: BaseException) -> bool:
    """Whether this is Python's, torch's or OpenCV's way to say that there is no more memory."""
    named = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    return named or any(text in str(error) for text in ("DefaultCPUAllocator: can't allocate", "Insufficient memory"))


def print_error(error: SSAError) -> int:
    """Print one line and return the exit code that the command ends with."""
    if isinstance(error, TrainingStopped):
        _print_line("stopped", str(error))
        return INTERRUPTED_EXIT_CODE
    _print_line("error", str(error))
    return TRAINING_EXIT_CODE if isinstance(error, TrainingError) else INPUT_EXIT_CODE


def print_interrupt(message: str) -> int:
    """Print what a command that was interrupted says, and return the exit code that it ends with."""
    _print(message)
    return INTERRUPTED_EXIT_CODE


def replace_closed_streams() -> None:
    """Open the null device where standard input, output or the error stream is closed.

    The next files would take their numbers, and get what C libraries print.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:  # a closed one's number
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w", closefd=False))  # noqa: SIM115 - for as long as the process lives


def show_warnings() -> None:
    """Print warnings that the library logs, one line each; calling it again changes nothing."""
    logger = logging.getLogger("ssa_nerfstudio")
    if not any(isinstance(handler, _OneLineHandler) for handler in logger.handlers):
        logger.addHandler(_OneLineHandler(logging.WARNING))


class _OneLineHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        _print_line(record.levelname.lower(), record.getMessage())


def _print_line(kind: str, message: str) -> None:
    _print(f"ssa-nerfstudio: {kind}: {' '.join(message.split())}")


def _print(line: str) -> None:
    """Print names as they are, but for what is no text, or would command the terminal."""
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    if sys.stderr is not None:
        with suppress(OSError):  # full or closed: the exit code still says it
            print(shown, file=sys.stderr, flush=True)
