"""What a hard case is: a name, what would go wrong, and a check. `python tests/stability/hard_cases.py` lists them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pytest


@dataclass
class Case:
    """One hard case."""

    name: str
    """What is hard, in a few words."""
    wrong: str
    """What would go wrong, in a sentence."""
    check: Callable[..., None]
    """Raises where it does go wrong."""
    slow: bool = False
    """Run by `make stability` only."""


@dataclass
class Family:
    """Cases of one kind."""

    name: str
    cases: list[Case] = field(default_factory=list)

    def case(self, name: str, wrong: str, *arguments: Any, slow: bool = False) -> Callable:
        """Decorate a check; it is called with `arguments` and then whatever the family's test passes."""

        def add(check: Callable[..., None]) -> Callable[..., None]:
            assert name not in [case.name for case in self.cases], f"two cases are called {name!r}"
            self.cases.append(Case(name, wrong, partial(check, *arguments), slow))
            return check

        return add

    @property
    def parametrize(self) -> pytest.MarkDecorator:
        """Run a test once for each case, which it gets as `case`."""
        marks = {True: [pytest.mark.stability], False: []}
        return pytest.mark.parametrize(
            "case", [pytest.param(case, id=case.name.replace(" ", "-"), marks=marks[case.slow]) for case in self.cases]
        )


def families() -> list[Family]:
    """Every family of the suite."""
    import test_densification_cases
    import test_overlay_cases
    import test_rasterizer_cases
    import test_statistics_cases
    import test_training_cases

    return [
        test_statistics_cases.STATISTICS,
        test_overlay_cases.OVERLAY,
        test_rasterizer_cases.RASTERIZER,
        test_densification_cases.DENSIFICATION,
        test_training_cases.TRAINING,
    ]


def listing() -> str:
    """The cases by family, as docs/stability.md has them."""
    lines = []
    for family in families():
        lines += [f"### {family.name} ({len(family.cases)})", "", "| case | what would go wrong |", "|---|---|"]
        lines += [f"| {case.name}{' *' if case.slow else ''} | {case.wrong} |" for case in family.cases]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    print(listing())
