"""One line and an exit code, instead of a traceback, where one of our exceptions ends a nerfstudio command."""

from __future__ import annotations

import shlex
import sys
import warnings
from pathlib import Path
from types import TracebackType

from ssa_nerfstudio._system.ctrl_c import is_interrupt
from ssa_nerfstudio._system.terminal_messages import print_error, refusal, show_warnings
from ssa_nerfstudio.errors import SSAError, TrainingStopped
from ssa_nerfstudio.plugin.config_tags import refuse_calls
from ssa_nerfstudio.plugin.failed_commands import culprit, option_value


def report_in_one_line() -> None:
    """Let a `ns-*` command end with one line and exit code 2 or 3 where one of our exceptions reaches its top level.

    nerfstudio's commands have no hook for this, so it is `sys.excepthook`. Scripts that import the plugin keep their
    tracebacks.
    """
    if not is_nerfstudio_command():
        return
    show_warnings()
    # nerfstudio's and torch's, of each other; no user can act on them.
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"(torch|nerfstudio|gsplat)(\.|$)")
    former = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        known = refusal(error) or culprit(error, traceback) or error
        if is_interrupt(error):
            known = TrainingStopped(f"{Path(sys.argv[0]).name} was stopped before it began")
        if isinstance(known, SSAError):
            raise SystemExit(print_error(known))  # the interpreter takes the exit code from here
        former(kind, error, traceback)

    sys.excepthook = hook


def check_config() -> None:
    """Look at the run of this `ns-*` command's `--load-config` before nerfstudio executes it.

    Raises:
        InputError: see `config_tags.refuse_calls`.
    """
    if is_nerfstudio_command() and (path := option_value("--load-config")):
        refuse_calls(Path(path))


def resuming(checkpoints: Path) -> str:
    """This `ns-train` command with the option that continues from a folder of checkpoints."""
    program, method, *options = sys.argv
    if "--load-dir" in options:
        at = options.index("--load-dir")
        options[at : at + 2] = []
    return shlex.join([Path(program).name, method, "--load-dir", str(checkpoints), *options])


def is_nerfstudio_command() -> bool:
    """Whether this process is `ns-...` or `python -m nerfstudio.scripts...`."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    module = "" if spec is None else spec.name
    return Path(sys.argv[0]).name.startswith("ns-") or module.startswith("nerfstudio.")
