"""A module that computes with other tensors in place of its parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from torch import Tensor, nn


@contextmanager
def parameters_replaced(module: nn.Module, tensors: Sequence[Tensor]) -> Iterator[None]:
    """Let a module compute with other tensors in place of its parameters, in the order of `parameters()`.

    As there, a parameter that is None is left out, and one that has several places counts once.
    """
    places = [(each, name) for each in module.modules() for name in each._parameters]
    held = [each._parameters[name] for each, name in places]
    other = {id(mine): given for mine, given in zip(module.parameters(), tensors, strict=True)}
    for (each, name), parameter in zip(places, held, strict=True):
        each._parameters[name] = other.get(id(parameter))  # pyright: ignore[reportArgumentType]
    try:
        yield
    finally:
        for (each, name), parameter in zip(places, held, strict=True):
            each._parameters[name] = parameter
