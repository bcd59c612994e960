"""The command `ssa`: one module a command, imported only when it is called."""

from __future__ import annotations

import importlib
import io
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from ssa_nerfstudio._system import ctrl_c, terminal_messages, termination
from ssa_nerfstudio._system.environment import check_environment, check_working_directory
from ssa_nerfstudio.errors import InputError, SSAError

COMMANDS = {
    "run": "From photos to clean splats, the artifact as a picture, and a report; resumable.",
    "bench": "Train and score a matrix of scenes, artifacts, methods and seeds; resumable.",
    "demo": "Build a small scene, add artifacts to its photos, train without and with the overlay, and report.",
    "detect": "Say whether photos have a static screen-space artifact, and where.",
    "process": "Make a nerfstudio dataset from photos or videos, with poses robust to a static artifact.",
    "report": "Tables and pictures from the results of ssa bench.",
    "simulate": "Add an artifact to the training photos of a nerfstudio dataset.",
    "export-dataset": "Write a capture with masks, or with cleaned photos, as another program reads it.",
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
    asks_for_help = not arguments or arguments[0] in ("-h", "--help")
    with termination.as_ctrl_c(), _errors_in_one_line("ssa" if asks_for_help else f"ssa {arguments[0]}"):
        if asks_for_help:
            print(_usage(), flush=True)
            raise SystemExit(0 if arguments else 2)
        if arguments[0] in ("-V", "--version"):
            from ssa_nerfstudio import __version__

            print(__version__)
            return
        _run(arguments[0], arguments[1:])


def run_script(command: type) -> None:
    """Run a script that is no command of `ssa` as if it were one: the same options, errors and exit codes.

    Args:
        command: a dataclass with a method `run`; its docstring is the first line of --help.
    """
    import inspect

    from ssa_nerfstudio.cli import arguments, option_bounds

    program = f"python {sys.argv[0]}"
    with termination.as_ctrl_c(), _errors_in_one_line(program):
        read = arguments.read(command, sys.argv[1:], program, inspect.getdoc(command) or "")
        option_bounds.require_values(read)
        read.run()


@contextmanager
def _errors_in_one_line(program: str) -> Iterator[None]:
    terminal_messages.replace_closed_streams()
    terminal_messages.show_warnings()
    warnings.simplefilter("ignore", FutureWarning)  # raised by libraries at import; no user can act on them
    warnings.filterwarnings("ignore", ".*The TBB threading layer")  # numba's, about a library of the system
    warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.")  # about metadata that is not read
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may be no text in the terminal's encoding
    try:
        with ctrl_c.unwrapped():
            yield
        sys.stdout.flush()
    except SSAError as error:
        raise SystemExit(terminal_messages.print_error(error)) from None
    except BrokenPipeError:  # as of `| head`: who read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        raise SystemExit(terminal_messages.BROKEN_PIPE_EXIT_CODE) from None
    except Exception as error:
        refused = terminal_messages.refusal(error)
        if refused is None:
            raise
        raise SystemExit(terminal_messages.print_error(refused)) from None
    except KeyboardInterrupt as interrupt:
        raise SystemExit(terminal_messages.print_interrupt(str(interrupt) or f"{program} was stopped")) from None


def _run(name: str, options: list[str]) -> None:
    check_working_directory()
    check_environment()
    if name not in COMMANDS:
        raise InputError(f"there is no command {name!r}", f"choose one of {', '.join(COMMANDS)} (ssa --help)")
    try:
        with termination.ended_at_once(f"ssa {name}"):
            from ssa_nerfstudio.cli import arguments

            command = importlib.import_module(f"ssa_nerfstudio.cli.{name.replace('-', '_')}").Command
            read = getattr(command, "read", partial(arguments.read, command))
            requested = read(options, f"ssa {name}", COMMANDS[name])
            # Its C code prints a traceback of its own where ctrl+c interrupts it, and every command needs it.
            importlib.import_module("cv2")
        requested.run()
    except ImportError as error:  # also of a library that misses an optional package of its own
        if (error.name or "").startswith("ssa_nerfstudio"):
            raise
        if name not in EXPERIMENTS:
            raise InputError(
                f"a library that ssa {name} needs cannot be loaded ({error})",
                "pip install --force-reinstall ssa-nerfstudio, or free memory",
            ) from error
        raise InputError(
            f"ssa {name} needs a package that is not installed ({error})", "pip install 'ssa-nerfstudio[experiments]'"
        ) from error


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(["usage: ssa COMMAND [options]", "", *lines, "", "ssa COMMAND --help lists a command's options."])
