"""Options of a command, read by tyro; the box of lines that tyro draws around an error becomes one line."""

from __future__ import annotations

import io
import os
import re
import shutil
from collections.abc import Sequence
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any, TypeVar

import tyro

from ssa_nerfstudio.errors import InputError

T = TypeVar("T")

STANDARD_OUTPUT = Path("-")
"""What an option for an output means by convention."""

_NO_HELP = ("For full helptext", "Argument helptext", "Available subcommands")
"""Beginnings of what tyro says beside the error: nerfstudio's subcommands are readers of fifteen dataset formats."""

_NARROWEST = 20
"""Columns of a terminal for which tyro finds a layout; for fewer than 3 it searches for ever."""


def read(command: type[T], arguments: list[str], program: str, description: str, **defaults: Any) -> T:
    """Build a command from its options.

    Args:
        command: a dataclass, flat unless `defaults` are given.
        arguments: what follows the command's name.
        program: the command as it is called, for messages: `ssa detect`.
        description: what --help says first.
        defaults: `default`, an instance whose values hold where no option is given.

    Raises:
        InputError: an option is unknown, missing, or has a value that it does not take; or --output is -, which would
            be the name of a folder or file.
        SystemExit: of code 0, after --help.
    """
    report = io.StringIO()
    if shutil.get_terminal_size().columns < _NARROWEST:
        os.environ["COLUMNS"] = str(_NARROWEST)
    try:
        with redirect_stderr(report):
            made = tyro.cli(command, args=arguments, prog=program, description=description, **defaults)
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(f"{_one_line(report.getvalue())} ({program} --help)") from None
    for name in ("output", "output_dir"):
        if getattr(made, name, None) == STANDARD_OUTPUT:
            option = name.replace("_", "-")
            raise InputError(f"--{option} -: {program} does not write to the standard output", "name a place on a disk")
    return made


def split_forwarded(arguments: list[str], prefixes: Sequence[str]) -> tuple[list[str], tuple[tuple[str, ...], ...]]:
    """Split off the options of other commands: `--PREFIX.NAME`, with the values that follow.

    Returns:
        The command's own arguments, and for each prefix those of the other command, as it takes them.
    """
    own: list[str] = []
    theirs: dict[str, list[str]] = {f"--{prefix}.": [] for prefix in prefixes}
    place = own
    for word in arguments:
        if word.startswith("--"):
            mark = next((mark for mark in theirs if word.startswith(mark)), "")
            place = theirs.get(mark, own)
            word = f"--{word[len(mark) :]}" if mark else word
        place.append(word)
    return own, tuple(tuple(words) for words in theirs.values())


def _one_line(report: str) -> str:
    """What is wrong, without title, borders (drawn where standard output is UTF-8), footer and options' help texts."""
    title, *sections = re.split(r"^(?:[╭╰].*|│? *[─-]{8,}.*)$", report, flags=re.MULTILINE)
    messages = []
    for section in sections or [title]:
        lines = [re.sub(r"^│ ?|│$|\[/?bold\]", "", line.rstrip()) for line in section.splitlines()]
        messages.append(" ".join(" ".join(line for line in lines if not line.startswith(" " * 8)).split()))
    return "; ".join(text for text in messages if text and not text.startswith(_NO_HELP))
