"""Which tests run a changed line: `python -m benchmarks.mutation.reach CHANGES.json REACHED.json PYTEST-ARGUMENTS`."""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import coverage
import pytest

from benchmarks.mutation import kernels


class Reach:
    """Notes what each test runs, what its fixtures ran for an earlier test included, and how long it takes."""

    def __init__(self, measured: coverage.Coverage) -> None:
        """Measure nothing yet; the coverage is running."""
        self.seconds: dict[str, float] = defaultdict(float)
        self.passed: set[str] = set()
        self.failed: set[str] = set()
        self.contexts: dict[str, list[str]] = {}
        """Of a test: its own, and those of fixtures that it shares with others."""
        self.kernels: dict[str, set[str]] = defaultdict(set)
        """By context: kernels that were called, by module and mangled name."""
        self._coverage = measured
        self._context = ""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Everything that a test runs is its own."""
        fixtures = getattr(item, "_fixtureinfo").name2fixturedefs.values()  # noqa: B009, no public name
        shared = [_context(of[-1]) for of in fixtures if of[-1].scope != "function"]
        self.contexts[item.nodeid] = [item.nodeid, *shared]
        before = self._switch(item.nodeid)
        try:
            return (yield)
        finally:
            self._switch(before)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """What a shared fixture runs is run for every test that asks for it."""
        if fixturedef.scope == "function":
            return (yield)
        before = self._switch(_context(fixturedef))
        try:
            return (yield)
        finally:
            self._switch(before)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note seconds and outcome."""
        self.seconds[report.nodeid] += report.duration
        if report.failed:
            self.failed.add(report.nodeid)
        elif report.when == "call" and report.passed:
            self.passed.add(report.nodeid)

    def reached(self, change: dict[str, Any], lines: dict[int, list[str]]) -> list[str]:
        """Tests that pass, and that run a change, given the contexts of each line of its file."""
        contexts = {context for line in change["lines"] for context in lines.get(line, ())}
        contexts |= {context for context, called in self.kernels.items() if change["function"] in called}
        return [name for name in self.passed - self.failed if not contexts.isdisjoint(self.contexts[name])]

    def _switch(self, context: str) -> str:
        before, self._context = self._context, context
        self.kernels[before] |= kernels.called
        kernels.called.clear()
        self._coverage.switch_context(context)
        return before


def _context(fixture: Any) -> str:
    return f"{fixture.baseid} {fixture.argname}"


def main(changes_path: str, reached_path: str, *arguments: str) -> None:
    """Run tests and write which of them run each change, and how long each takes."""
    changes = json.loads(Path(changes_path).read_text())
    files = sorted({change["file"] for change in changes.values()})
    measured = coverage.Coverage(data_file=None, config_file=False, include=files)
    reach = Reach(measured)
    kernels.watched = True
    measured.start()
    pytest.main(
        ["-q", "--tb=short", "--continue-on-collection-errors", "-p", "no:cacheprovider", *arguments], plugins=[reach]
    )
    measured.stop()
    lines = {file: measured.get_data().contexts_by_lineno(file) for file in files}
    reached = {name: reach.reached(change, lines[change["file"]]) for name, change in changes.items()}
    written = {"seconds": reach.seconds, "reached": reached, "failed": sorted(reach.failed)}
    Path(reached_path).write_text(json.dumps(written, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
