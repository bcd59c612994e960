"""How the software refuses: one line that names the culprit and the remedy, exit code 2."""

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
    message = " ".join(message.split())
    print(f"ssa-nerfstudio: error: {message}", file=sys.stderr, flush=True)
    return BadInput(message)
