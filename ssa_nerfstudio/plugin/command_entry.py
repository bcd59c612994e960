"""One line and an exit code, instead of a traceback, where one of our exceptions ends a nerfstudio command."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType

from ssa_nerfstudio._system.terminal_messages import print_error, show_warnings
from ssa_nerfstudio.errors import SSAError


def report_in_one_line() -> None:
    """Let a `ns-*` command end with one line and exit code 2 or 3 where one of our exceptions reaches its top level.

    nerfstudio's commands have no hook for this, so it is `sys.excepthook`. Scripts that import the plugin keep their
    tracebacks.
    """
    if not is_nerfstudio_command():
        return
    show_warnings()
    former = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(error, SSAError):
            raise SystemExit(print_error(error))  # the interpreter takes the exit code from here
        former(kind, error, traceback)

    sys.excepthook = hook


def is_nerfstudio_command() -> bool:
    """Whether this process is `ns-...` or `python -m nerfstudio.scripts...`."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    module = "" if spec is None else spec.name
    return Path(sys.argv[0]).name.startswith("ns-") or module.startswith("nerfstudio.")
