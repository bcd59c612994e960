"""Nested values with something wrong in them at random: what people's files may hold."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from ssa_nerfstudio.errors import InputError

ODD = [
    None,
    True,
    False,
    -1,
    0,
    1,
    7,
    1e308,
    -1e-308,
    math.nan,
    math.inf,
    "",
    "x",
    "../..",
    "é" * 300,
    [],
    {},
    [1, 2],
    [[]],
]
"""What is put in the place of a value."""
OFTEN = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def places(content: Any, path: tuple = ()) -> list[tuple]:
    """The path to every value of nested dictionaries and lists."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [path] * bool(path) + [place for key, value in inner for place in places(value, (*path, key))]


def mutated(content: Any, draw: Callable) -> Any:
    """A copy with one to three values replaced, removed or renamed."""
    content = copy.deepcopy(content)
    for _ in range(draw(st.integers(1, 3))):
        where = draw(st.sampled_from(places(content) or [()]))
        if not where:
            break
        holder = content
        for key in where[:-1]:
            holder = holder[key]
        how = draw(st.sampled_from(["replace", "remove", "rename"]))
        if how == "replace":
            holder[where[-1]] = copy.deepcopy(draw(st.sampled_from(ODD)))
        elif how == "remove" or isinstance(holder, list):
            del holder[where[-1]]
        else:
            holder[draw(st.sampled_from(["", "effect", "frames", "steps", 3]))] = holder.pop(where[-1])
    return content


def one_line(refused: InputError, culprit: str = "") -> None:
    assert str(refused)
    assert culprit in str(refused)
    assert "\n" not in str(refused)
