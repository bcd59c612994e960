"""Errors and warnings as one line on the error stream: what commands show instead of tracebacks and log records."""

from __future__ import annotations

import logging
import os
import sys
from typing import TYPE_CHECKING

from ssa_nerfstudio.errors import InputError, SSAError, TrainingError, TrainingStopped

if TYPE_CHECKING:
    from rich.console import Console

INPUT_EXIT_CODE = 2
"""Of a command whose input cannot be used."""
TRAINING_EXIT_CODE = 3
"""Of a command whose training could not continue although its input was fine."""
INTERRUPTED_EXIT_CODE = 130
"""Of a command that ctrl+c ended, as shells have it."""


BROKEN_PIPE_EXIT_CODE = 141
"""Of a command whose output nobody reads any more, as shells have it."""


def plain_console() -> Console:
    """A console for text that holds paths: `[x]` is no markup and `:x:` no emoji, and lines are not wrapped."""
    from rich.console import Console  # not before ctrl+c is handled

    return Console(highlight=False, soft_wrap=True, markup=False, emoji=False)


def refusal(error: OSError) -> InputError | None:
    """What an error of the operating system says to a user: which file, and why. None where it does not say why."""
    if not error.strerror:
        return None
    name = os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else "the system refused a file"
    return InputError(f"{name}: {error.strerror}", "check the path, its permissions and the room on its disk")


def print_error(error: SSAError) -> int:
    """Print one line and return the exit code that the command ends with."""
    if isinstance(error, TrainingStopped):
        _print_line("stopped", str(error))
        return INTERRUPTED_EXIT_CODE
    _print_line("error", str(error))
    return TRAINING_EXIT_CODE if isinstance(error, TrainingError) else INPUT_EXIT_CODE


def show_warnings() -> None:
    """Print warnings that the library logs, one line each; calling it again changes nothing."""
    logger = logging.getLogger("ssa_nerfstudio")
    if not any(isinstance(handler, _OneLineHandler) for handler in logger.handlers):
        logger.addHandler(_OneLineHandler(logging.WARNING))


class _OneLineHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        _print_line(record.levelname.lower(), record.getMessage())


def _print_line(kind: str, message: str) -> None:
    line = f"ssa-nerfstudio: {kind}: {' '.join(message.split())}"
    print(line.encode("utf-8", "backslashreplace").decode(), file=sys.stderr, flush=True)
