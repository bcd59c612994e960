"""The command `ssa`: one module a command, imported only when it is called."""

from __future__ import annotations

import importlib
import sys
import warnings

COMMANDS = {
    "bench": "Train and score a matrix of scenes, artifacts, methods and seeds; resumable.",
    "demo": "Build a small scene, put artifacts in front of it, train without and with the overlay, and report.",
    "detect": "Say whether photos have a static artifact in front of the scene, and where.",
    "process": "Make a nerfstudio dataset from photos or videos, with poses that a static artifact does not mislead.",
    "report": "Tables and pictures from the results of ssa bench.",
    "simulate": "Put an artifact in front of the training photos of a nerfstudio dataset.",
    "export-overlay": "Write the artifact that a run learned as pictures and masks, and take it off photos.",
    "export-splats": "Write a run's clean splats as PLY, as ns-export gaussian-splat does, and compressed.",
    "tradeoff": "What accuracy costs in time: one knob at a time and a few together, with frontier and knee.",
}
"""Name and one line of help of each command; its module holds a dataclass `Command` with a method `run`."""
INTERRUPTED = 130
"""Exit code after ctrl+c: what shells give a command that the signal ended."""


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
    if name not in COMMANDS:
        from ssa_nerfstudio.errors import refuse

        raise refuse(f"there is no command {name!r}; choose one of {', '.join(COMMANDS)} (ssa --help)")
    from ssa_nerfstudio.cli import arguments as options

    warnings.simplefilter("ignore", FutureWarning)  # libraries' own, at import: nothing that a user could act on
    try:
        command = importlib.import_module(f"ssa_nerfstudio.cli.{name.replace('-', '_')}").Command
        options.read(command, rest, f"ssa {name}", COMMANDS[name]).run()
    except KeyboardInterrupt:
        print(f"ssa {name} was stopped", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(["usage: ssa COMMAND [options]", "", *lines, "", "ssa COMMAND --help tells a command's options."])
