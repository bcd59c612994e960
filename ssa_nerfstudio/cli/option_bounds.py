"""What the values of a command's options may be, as their types state it: `rounds: Count`, `scale_factor: Factor`."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import tyro

from ssa_nerfstudio.errors import InputError


@dataclasses.dataclass(frozen=True)
class Bound:
    """What holds for each value of an option, beside its type."""

    words: str
    """What a value must be."""
    holds: Callable[[Any], bool]
    """Whether it is."""


def at_least(lowest: int) -> Bound:
    """Numbers from `lowest` on, infinity left out."""
    return Bound(f"at least {lowest}", lambda value: lowest <= value < math.inf)


def file_to_write(*suffixes: str) -> Bound:
    """Files that can be written, with one of these suffixes where there are some."""

    def holds(path: Path) -> bool:
        named = path.suffix in suffixes if suffixes else bool(path.name)
        return named and not path.is_dir() and os.access(path if path.exists() else path.parent, os.W_OK)

    kind = f"a {' or '.join(suffixes)} file" if suffixes else "a file"
    return Bound(f"{kind} in a folder that exists and can be written", holds)


NotNegative = Annotated[int, at_least(0)]
"""As of seeds."""
Count = Annotated[int, at_least(1)]
"""As of steps."""
Factor = Annotated[float, Bound("above 0 and finite", lambda value: 0 < value < math.inf)]
"""By which something is resized."""
Share = Annotated[float, Bound("in (0, 1)", lambda value: 0 < value < 1)]
"""As of thresholds of a matte."""
Method = Literal["ssa-splatfacto", "ssa-splatfacto-fast", "ssa-splatfacto-mcmc", "ssa-splatfacto-paper"]
"""nerfstudio's names of this plugin's methods."""


def check(command: Any) -> None:
    """Refuse values out of bounds.

    Args:
        command: a dataclass of options, read from the command line.

    Raises:
        InputError: a value is out of its bounds.
    """
    hints = get_type_hints(type(command), include_extras=True)
    for field in dataclasses.fields(command):
        hint, value = hints[field.name], getattr(command, field.name)
        marks = getattr(hint, "__metadata__", ())
        option = field.name.upper() if tyro.conf.Positional in marks else f"--{field.name.replace('_', '-')}"
        # Of `Annotated[int, ...]` the bounds are its own, of `tuple[Annotated[int, ...], ...]` and the like a part's.
        bounds = [mark for part in (hint, *get_args(hint)) for mark in getattr(part, "__metadata__", ())]
        for each in value if isinstance(value, tuple) else [] if value is None else [value]:
            for bound in [bound for bound in bounds if isinstance(bound, Bound) and not bound.holds(each)]:
                shown = f"{each:g}" if isinstance(each, float) else each
                raise InputError(f"{option} must be {bound.words}, got {shown}")


def require_values(command: Any) -> None:
    """Refuse options of several values that have none, though by default they have some.

    Args:
        command: as for `check`.

    Raises:
        InputError: an option has no value.
    """
    for field in dataclasses.fields(command):
        if getattr(command, field.name) == () != field.default:
            raise InputError(f"--{field.name.replace('_', '-')} has no value", "give it at least one")
