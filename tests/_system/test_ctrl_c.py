"""Ctrl+c within compiled code is no other than elsewhere."""

from __future__ import annotations

import pytest

from ssa_nerfstudio._system import ctrl_c


def compiled() -> None:
    """As CPython ends a compiled function that was interrupted."""
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as interrupt:
        raise SystemError("CPUDispatcher(f) returned a result with an exception set") from interrupt


def test_an_interrupt_within_a_compiled_function_is_one():
    with pytest.raises(KeyboardInterrupt), ctrl_c.unwrapped():
        compiled()


def nested() -> None:
    """The same of two compiled functions, one in the other."""
    try:
        compiled()
    except SystemError as inner:
        raise SystemError("CPUDispatcher(g) returned a result with an exception set") from inner


def test_an_interrupt_within_nested_compiled_functions_is_one():
    with pytest.raises(KeyboardInterrupt), ctrl_c.unwrapped():
        nested()


@pytest.mark.parametrize(
    "error", [SystemError("bad argument to internal function"), ValueError("x"), KeyboardInterrupt()]
)
def test_everything_else_stays_what_it_is(error):
    with pytest.raises(type(error)) as raised, ctrl_c.unwrapped():
        raise error
    assert raised.value is error
