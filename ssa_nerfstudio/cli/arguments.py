"""A command's options, read by tyro; what tyro does not take is explained in one line.

tyro alone decides what is right. Why something is not is found out from the dataclass's fields, so that nothing depends
on how tyro words or draws its own messages, which are boxes of many lines.
"""

from __future__ import annotations

import dataclasses
import difflib
import io
import types
import typing
from contextlib import redirect_stderr
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

from ssa_nerfstudio.errors import InputError

T = TypeVar("T")

_KINDS = {int: ("a whole number", "whole numbers"), float: ("a number", "numbers"), Path: ("a path", "paths")}
"""What a value of a type is called, one and several of them."""


def read(command: type[T], arguments: list[str], program: str, description: str) -> T:
    """The command with its options.

    Args:
        command: a flat dataclass; fields of `bool` are switches.
        arguments: what follows the command's name.
        program: the command as it is called, for messages: `ssa detect`.
        description: what --help says first.

    Raises:
        InputError: an option is unknown, missing, or has a value that it does not take.
        SystemExit: of code 0, after --help.
    """
    try:
        with redirect_stderr(io.StringIO()):
            return tyro.cli(command, args=arguments, prog=program, description=description)
    except SystemExit as end:
        if not end.code:
            raise
    raise InputError(f"{_explain(_options(command), arguments)} ({program} --help)")


@dataclasses.dataclass(frozen=True)
class _Option:
    """A field of a command as it is written on the command line."""

    flag: str
    """--name, or its name in capitals where it is positional."""
    type: Any
    required: bool
    positional: bool

    @property
    def flags(self) -> list[str]:
        """All ways to write it."""
        return [self.flag, f"--no-{self.flag[2:]}"] if self.type is bool else [self.flag]

    @property
    def most(self) -> float:
        """How many values it takes at most."""
        if self.type is bool:
            return 0
        if typing.get_origin(self.type) is not tuple:
            return 1
        members = typing.get_args(self.type)
        return float("inf") if members[-1] is ... else len(members)

    @property
    def takes(self) -> str:
        """What it takes, in words."""
        if self.type is bool:
            return "no value"
        if typing.get_origin(self.type) is Literal:
            return f"one of {', '.join(map(str, typing.get_args(self.type)))}"
        if typing.get_origin(self.type) is tuple:
            several = _KINDS.get(typing.get_args(self.type)[0], ("", "values"))[1]
            return several if self.most == float("inf") else f"{self.most} {several}"
        return _KINDS.get(self.type, ("a value", ""))[0]

    def accepts(self, values: list[str]) -> bool:
        """Whether tyro takes these values for it."""
        if self.type is bool:
            return not values
        if self.most == 1 and not values:
            return False
        try:
            with redirect_stderr(io.StringIO()):
                tyro.cli(self.type, args=values)
        except SystemExit:
            return False
        return True


def _options(command: type) -> list[_Option]:
    hints = typing.get_type_hints(command, include_extras=True)
    options = []
    for field in dataclasses.fields(command):
        hint, positional = hints[field.name], False
        if typing.get_origin(hint) is Annotated:
            hint, *extras = typing.get_args(hint)
            positional = tyro.conf.Positional in extras
        if typing.get_origin(hint) in (typing.Union, types.UnionType):
            hint = next(member for member in typing.get_args(hint) if member is not type(None))
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        name = field.name.upper() if positional else f"--{field.name.replace('_', '-')}"
        options.append(_Option(name, hint, required, positional))
    return options


def _explain(options: list[_Option], arguments: list[str]) -> str:
    """The first thing that is wrong: an unknown option, a value, a stray word, what is missing."""
    by_flag = {flag: option for option in options for flag in option.flags if not option.positional}
    given: list[tuple[str, list[str]]] = []
    stray: list[str] = []
    for word in arguments:
        if _is_flag(word):
            flag, equals, value = word.partition("=")
            flag = flag.replace("_", "-")
            if flag not in by_flag:
                return f"there is no option {flag}; {_similar(flag, by_flag)}"
            given.append((flag, [value] if equals else []))
        elif given and len(given[-1][1]) < (by_flag[given[-1][0]].most or 1):
            given[-1][1].append(word)
        else:
            stray.append(word)
    for flag, values in given:
        if not by_flag[flag].accepts(values):
            return f"{flag} takes {by_flag[flag].takes}, got {' '.join(map(repr, values)) or 'nothing'}"
    places = sum(option.most for option in options if option.positional)
    missing = [option for option in options if option.required and option.flag not in dict(given)]
    if len(stray) > places:
        remedy = f"did you mean {missing[0].flag} {stray[0]}?" if missing else "a path with spaces needs quotes"
        return f"{stray[-1]!r} belongs to no option; {remedy}"
    missing = [option for option in missing if not (option.positional and stray)]
    if missing:
        named = ", ".join(f"{option.flag} ({option.takes})" for option in missing)
        return f"{named} {'is' if len(missing) == 1 else 'are'} missing"
    return f"these options are not understood: {' '.join(arguments)}"


def _similar(flag: str, flags: typing.Iterable[str]) -> str:
    names = [name[2:] for name in flags]
    if close := difflib.get_close_matches(flag.lstrip("-"), names, n=1, cutoff=0.7):
        return f"did you mean --{close[0]}?"
    return f"there are {', '.join(f'--{name}' for name in names if not name.startswith('no-'))}"


def _is_flag(word: str) -> bool:
    return word.startswith("--") or (word[:1] == "-" and word[1:2].isalpha())
