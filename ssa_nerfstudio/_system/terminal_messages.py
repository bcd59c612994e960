"""Errors and warnings as one line on the error stream: what commands show instead of tracebacks and log records."""

from __future__ import annotations

import logging
import sys

from ssa_nerfstudio.errors import SSAError, TrainingError

INPUT_EXIT_CODE = 2
"""Of a command whose input cannot be used."""
TRAINING_EXIT_CODE = 3
"""Of a command whose training could not continue although its input was fine."""
INTERRUPTED_EXIT_CODE = 130
"""Of a command that ctrl+c ended, as shells have it."""


def print_error(error: SSAError) -> int:
    """Print one line and return the exit code that the command ends with."""
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
    print(f"ssa-nerfstudio: {kind}: {' '.join(message.split())}", file=sys.stderr, flush=True)
