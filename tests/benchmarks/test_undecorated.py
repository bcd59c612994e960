"""Decorators as statements: what mutmut can change means what it meant."""

from __future__ import annotations

from typing import Any

from benchmarks.mutation.undecorated import undecorated

SOURCE = '''
"""A module."""
from functools import cache, wraps


def twice(function):
    @wraps(function)
    def doubled(*arguments):
        return 2 * function(*arguments)

    return doubled


def more(amount):
    return lambda function: lambda *arguments: function(*arguments) + amount


@more(1)
@twice
def seven(
    one: int = 1,
) -> int:
    return 6 + one


@cache
def calls():
    return []


class Thing:
    side = 3

    @property
    def area(self):
        return self.side**2

    @staticmethod
    @twice
    def half(x):
        return x / 2

    @staticmethod
    def plain(x):
        return x

    @classmethod
    def small(cls):
        made = cls()
        made.side = 1
        return made


def last():
    return seven() + Thing.half(4)
'''


def run(source: str) -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(source, names)
    return names


def test_every_decorator_is_applied_after_its_function_and_in_its_order():
    for source in (SOURCE, undecorated(SOURCE)):
        names = run(source)
        assert names["seven"]() == 15
        assert names["seven"](3) == 19
        assert names["calls"]() is names["calls"]()
        thing = names["Thing"]
        assert (thing().area, thing.small().area, thing.half(5), thing().half(5), thing.plain(2)) == (9, 1, 5, 5, 2)
        assert names["last"]() == 19
    lines = [line.strip() for line in undecorated(SOURCE).splitlines()]
    assert [line for line in lines if line.startswith("@")] == ["@wraps(function)", "@staticmethod", "@classmethod"]


def test_kernels_are_compiled_later_and_what_only_numba_calls_stays_as_it_is():
    source = "@njit(cache=True)\ndef f(x):\n    return x\n\n\n@overload(f)\ndef g(x):\n    return x\n"
    lines = undecorated(source).splitlines()
    assert "@overload(f)" in lines
    assert not any(line.startswith("@njit") for line in lines)
    (kernel,) = (line for line in lines if line.startswith("f = "))
    assert kernel.endswith("Kernel(f, njit(cache=True))")


def test_a_module_without_decorators_is_left_alone():
    source = "def f():\n    return 1\n"
    assert undecorated(source) == source


def test_what_is_made_when_a_module_is_read_is_made_at_every_call():
    source = "made = []\n\n\ndef make_sum(x):\n    made.append(x)\n    return lambda y: x + y\n\n\nplus = make_sum(2)\n"
    names = run(undecorated(source))
    assert names["made"] == []
    assert [names["plus"](3), names["plus"](y=4)] == [5, 6]
    assert names["made"] == [2, 2]
