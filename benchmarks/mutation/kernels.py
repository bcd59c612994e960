"""Numba's kernels under mutation: each process compiles the one mutant that it tests."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator
from typing import Any

from mutmut.mutation.trampoline import get_mutant_under_test
from numba.core.caching import NullCache

watched = False
"""Whether to note which kernels are called: coverage.py does not see machine code."""
called: set[str] = set()
"""Module and mangled name of those that were."""


class Kernel:
    """A dispatcher of numba's whose function is chosen at the first call; other kernels can call it."""

    def __init__(self, function: Callable, decorate: Callable[[Callable], Any]) -> None:
        """Store a function that mutmut may have wrapped, and the decorator `njit(...)`."""
        self._plain = getattr(function, "__wrapped__", function)
        self._decorate = decorate
        self._compiled: dict[str, Any] = {}

    def __call__(self, *arguments: Any) -> Any:
        """Run the original, or the mutant that is tested."""
        if watched:
            called.update(f"{kernel._plain.__module__}.x_{kernel._plain.__name__}" for kernel in self._with_callees())
        return self._dispatcher()(*arguments)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._dispatcher(), name)

    def _dispatcher(self) -> Any:
        tested = get_mutant_under_test()
        if tested not in self._compiled:
            dispatcher = self._decorate(self._renamed(self._mutant(tested) or self._original()))
            if any(kernel._mutant(tested) for kernel in self._with_callees()):
                dispatcher._cache = NullCache()  # numba's cache knows neither constants nor callees
            self._compiled[tested] = dispatcher
        return self._compiled[tested]

    def _variants(self) -> dict[str, Callable]:
        return self._plain.__globals__.get(f"mutants_x_{self._plain.__name__}__mutmut", {})

    def _mutant(self, tested: str) -> Callable | None:
        module, _, name = tested.rpartition(".")
        return self._variants().get(name) if module == self._plain.__module__ else None

    def _original(self) -> Callable:
        return self._variants().get("_mutmut_orig", self._plain)

    def _renamed(self, function: Any) -> Callable:
        """The function under the kernel's name."""
        name = self._plain.__name__
        code = function.__code__.replace(co_name=name)
        renamed = types.FunctionType(code, function.__globals__, name, function.__defaults__)
        renamed.__module__ = self._plain.__module__
        return renamed

    def _with_callees(self) -> Iterator[Kernel]:
        """This kernel and those that it calls, directly or through others."""
        seen, waiting = [], [self]
        while waiting:
            kernel = waiting.pop()
            if kernel in seen:
                continue
            seen.append(kernel)
            yield kernel
            for name in kernel._plain.__code__.co_names:
                callee = kernel._plain.__globals__.get(name)
                if isinstance(callee, Kernel):
                    waiting.append(callee)
                elif isinstance(callee, types.FunctionType):  # of `overload`: its module has the kernels behind it
                    waiting += [other for other in callee.__globals__.values() if isinstance(other, Kernel)]
