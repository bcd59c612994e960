"""Options of a command, read by tyro; the box of lines that tyro draws around an error becomes one line."""

from __future__ import annotations

import io
import os
import re
import shutil
from collections.abc import Sequence
from contextlib import redirect_stderr, suppress
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from ssa_nerfstudio.cli import option_bounds
from ssa_nerfstudio.errors import InputError

T = TypeVar("T")

STANDARD_OUTPUT = Path("-")
"""What an option for an output means by convention."""

_NO_HELP = ("For full helptext", "Argument helptext", "Available subcommands")
"""Beginnings of what tyro says beside the error: nerfstudio's subcommands are readers of fifteen dataset formats."""

_NARROWEST = 20
"""Columns of a terminal for which tyro finds a layout; for fewer than 3 it searches for ever."""

_NUMBERS = ConstructorRegistry()
_KINDS = {int: "whole number", float: "number"}


@_NUMBERS.primitive_rule
def _numbers(option: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """How tyro reads numbers, or so many, that may be None: its own errors are about unions and Python's types."""
    members = get_args(option.type) if option.type_origin in (Union, UnionType) else (option.type,)
    wanted = [member for member in members if member is not NoneType]
    several = len(wanted) == 1 and get_origin(wanted[0]) is tuple
    kinds = [*get_args(wanted[0])] if several else wanted
    if not kinds or kinds[0] not in _KINDS or any(kind is not kinds[0] for kind in kinds) or len(wanted) > 1:
        return None
    kind, count, optional = kinds[0], len(kinds), NoneType in members
    expected = f"{count} {_KINDS[kind]}s" if several else f"a {_KINDS[kind]}"

    def parse(words: list[str]) -> float | tuple[float, ...] | None:
        if optional and words == ["None"]:
            return None
        numbers: list[float] = []
        with suppress(ValueError):
            numbers = [kind(word) for word in words]
        if len(numbers) != count:
            raise ValueError(f"expected {expected}, got {' '.join(words)!r}")
        return tuple(numbers) if several else numbers[0]

    def words_of(value: float | tuple[float, ...] | None) -> list[str]:
        return [str(each) for each in value] if isinstance(value, tuple) else [str(value)]

    def holds(value: object) -> bool:
        if value is None or isinstance(value, tuple) != several:
            return optional and value is None
        return all(isinstance(each, (int, kind)) for each in (value if isinstance(value, tuple) else (value,)))

    names = " ".join([kind.__name__.upper()] * count)
    metavar = f"{{None}}|{f'{{{names}}}' if several else names}" if optional else names
    return PrimitiveConstructorSpec("*" if optional and several else count, metavar, parse, holds, words_of)


def read(command: type[T], arguments: list[str], program: str, description: str, **defaults: Any) -> T:
    """Build a command from its options.

    Args:
        command: a dataclass, flat unless `defaults` are given.
        arguments: what follows the command's name.
        program: the command as it is called, for messages: `ssa detect`.
        description: what --help says first.
        defaults: `default`, an instance whose values hold where no option is given.

    Raises:
        InputError: an option is unknown, missing, or has a value that it does not take, of a flat command also one out
            of bounds (`option_bounds`); or --output is -, which would be the name of a folder or file.
        SystemExit: of code 0, after --help.
    """
    report = io.StringIO()
    if shutil.get_terminal_size().columns < _NARROWEST:
        os.environ["COLUMNS"] = str(_NARROWEST)
    try:
        with redirect_stderr(report), _NUMBERS:
            made = tyro.cli(command, args=arguments, prog=program, description=description, **defaults)
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(f"{_one_line(report.getvalue())} ({program} --help)") from None
    for name in ("output", "output_dir"):
        if getattr(made, name, None) == STANDARD_OUTPUT:
            option = name.replace("_", "-")
            raise InputError(f"--{option} -: {program} does not write to the standard output", "name a place on a disk")
    if not defaults:
        option_bounds.check(made)
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
