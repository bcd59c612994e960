"""How the software refuses: one line that names the culprit and the remedy.

Exit code 2: the input cannot be worked with. Exit code 3: the input was fine, and the training could not go on.
"""

from __future__ import annotations

import sys


class BadInput(SystemExit):
    """Input that cannot be worked with: a `SystemExit` of code 2, which ends `ns-*` commands without a traceback."""

    def __init__(self, message: str) -> None:
        """Take the whole message: what is wrong with what, and what to do about it, in one line."""
        super().__init__(2)
        self.message = message

    def __str__(self) -> str:
        return self.message


def refuse(message: str) -> BadInput:
    """Print the message as one line on the error stream and return the exception to raise: `raise refuse(...)`."""
    return BadInput(_print(message))


class TrainingFailed(SystemExit):
    """A training that cannot go on though its input was fine: a `SystemExit` of code 3."""

    def __init__(self, message: str) -> None:
        """Take the whole message: what happened at which step, and what to do about it, in one line."""
        super().__init__(3)
        self.message = message

    def __str__(self) -> str:
        return self.message


def give_up(message: str) -> TrainingFailed:
    """Print the message as one line on the error stream and return the exception to raise: `raise give_up(...)`."""
    return TrainingFailed(_print(message))


def warn(message: str) -> None:
    """Print the message as one line on the error stream, and go on."""
    _print(message, "warning")


def _print(message: str, kind: str = "error") -> str:
    message = " ".join(message.split())
    print(f"ssa-nerfstudio: {kind}: {message}", file=sys.stderr, flush=True)
    return message
