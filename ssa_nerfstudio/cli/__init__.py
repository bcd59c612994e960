"""The command `ssa`: one module a command, imported only when it is called."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from ssa_nerfstudio._system import terminal_messages
from ssa_nerfstudio.errors import InputError, SSAError

COMMANDS = {
    "bench": "Train and score a matrix of scenes, artifacts, methods and seeds; resumable.",
    "demo": "Build a small scene, add artifacts to its photos, train without and with the overlay, and report.",
    "detect": "Say whether photos have a static screen-space artifact, and where.",
    "process": "Make a nerfstudio dataset from photos or videos, with poses robust to a static artifact.",
    "report": "Tables and pictures from the results of ssa bench.",
    "simulate": "Add an artifact to the training photos of a nerfstudio dataset.",
    "export-overlay": "Write the artifact that a run learned as pictures and masks, and remove it from photos.",
    "export-splats": "Write a run's clean splats as PLY, as ns-export gaussian-splat does, and compressed.",
    "tradeoff": "What accuracy costs in time: one knob at a time and a few together, with frontier and knee.",
}
"""Name and one line of help of each command; its module holds a dataclass `Command` with a method `run`."""
EXPERIMENTS = {"bench", "demo", "report", "simulate", "tradeoff"}
"""Commands that need the extra `experiments`."""


def main(arguments: list[str] | None = None) -> None:
    """Run `ssa COMMAND [options]`.

    Args:
        arguments: what follows `ssa`; the process's own where None.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
        raise SystemExit(0 if arguments else 2)
    name, *rest = arguments
    if name in ("-V", "--version"):
        from ssa_nerfstudio import __version__

        print(__version__)
        return
    with _errors_in_one_line(f"ssa {name}"):
        _run(name, rest)


def run_script(command: type) -> None:
    """Run a script that is no command of `ssa` as if it were one: the same options, errors and exit codes.

    Args:
        command: a dataclass with a method `run`; its docstring is the first line of --help.
    """
    import inspect

    from ssa_nerfstudio.cli import arguments

    program = f"python {sys.argv[0]}"
    with _errors_in_one_line(program):
        arguments.read(command, sys.argv[1:], program, inspect.getdoc(command) or "").run()


@contextmanager
def _errors_in_one_line(program: str) -> Iterator[None]:
    terminal_messages.show_warnings()
    warnings.simplefilter("ignore", FutureWarning)  # raised by libraries at import; no user can act on them
    try:
        yield
    except SSAError as error:
        raise SystemExit(terminal_messages.print_error(error)) from None
    except KeyboardInterrupt as interrupt:
        print(str(interrupt) or f"{program} was stopped", file=sys.stderr)
        raise SystemExit(terminal_messages.INTERRUPTED_EXIT_CODE) from None


def _run(name: str, options: list[str]) -> None:
    if name not in COMMANDS:
        raise InputError(f"there is no command {name!r}", f"choose one of {', '.join(COMMANDS)} (ssa --help)")
    from ssa_nerfstudio.cli import arguments

    command = importlib.import_module(f"ssa_nerfstudio.cli.{name.replace('-', '_')}").Command
    try:
        arguments.read(command, options, f"ssa {name}", COMMANDS[name]).run()
    except ImportError as error:  # also of a library that misses an optional package of its own
        if name not in EXPERIMENTS or (error.name or "").startswith("ssa_nerfstudio"):
            raise
        raise InputError(
            f"ssa {name} needs a package that is not installed ({error})", "pip install 'ssa-nerfstudio[experiments]'"
        ) from error


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(["usage: ssa COMMAND [options]", "", *lines, "", "ssa COMMAND --help lists a command's options."])
