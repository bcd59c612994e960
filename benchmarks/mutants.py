"""Which changes of meaning the tests of a folder notice: `python benchmarks/mutants.py --room overlay`."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from mutation.changed_folder import KNOWN, NOTICED, ChangedFolder

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, NotNegative, at_least
from ssa_nerfstudio.errors import InputError

ROOT = Path(__file__).parents[1]
ALL = "all"
"""The whole package: every folder of it that has tests, each changed and tested by itself."""


@dataclass
class Command:
    """Change a folder of the package one line at a time, and write which changes its tests do not notice."""

    room: str = "overlay"
    """Folder below ssa_nerfstudio, and below tests: overlay, evidence, plugin/training, ...; or all of them: all."""
    output: Path = Path("build/mutants")
    """Folder to work in. A stopped run continues; survivors and mutants of changed functions are tried anew."""
    children: Count = field(default_factory=usable_cores)
    """Mutants tried at once."""
    sample: NotNegative = 0
    """Try so many, drawn at random from all changes that are asked for; 0: all."""
    seed: int = 0
    """Of the sample."""
    budget: Annotated[float, at_least(1)] = 60
    """Seconds of tests for each change, those of the quickest files first."""
    named: bool = False
    """Use all tests of files that name the changed module, and do not measure which reach the change: quicker for a
    small sample, but more changes seem unnoticed."""

    def run(self) -> None:
        """Try what is left, and write OUTPUT/ROOM.md.

        Raises:
            InputError: there is no such folder.
        """
        rooms = [ChangedFolder(name, self.output.resolve() / name) for name in self._names()]
        before = {room: room.prepared() for room in rooms}
        every = [(room, change) for room in rooms for change in sorted(before[room])]
        chosen = random.Random(self.seed).sample(every, min(self.sample, len(every))) if self.sample else every
        tried: dict[str, str] = {}
        shown: dict[str, str] = {}
        for room in rooms:
            changes = [change for of, change in chosen if of == room]
            if todo := [change for change in changes if before[room][change] not in KNOWN]:
                room.try_changes(todo, self.children, self.budget, self.named)
            after = room.found()
            tried |= {change: after[change] for change in changes}
            shown |= {name: room.shown(name) for name in changes if after[name] not in NOTICED}
        page = self.output / f"{self.room.replace('/', '-')}.md"
        drawn = f" SAMPLE={self.sample} SEED={self.seed}" if self.sample else ""
        page.write_text(_page(f"{self.room}{drawn}", tried, shown, len(every)))
        print(page)

    def _names(self) -> list[str]:
        package, tests = ROOT / "ssa_nerfstudio", ROOT / "tests"
        if self.room == ALL:
            return sorted(
                folder.name for folder in package.iterdir() if any((tests / folder.name).glob("**/test_*.py"))
            )
        for folder in (package, tests):
            if not (folder / self.room).is_dir():
                raise InputError(f"there is no folder {folder.name}/{self.room}", f"name one below both, or {ALL}")
        return [self.room]


def _page(room: str, found: dict[str, str], changes: dict[str, str], total: int) -> str:
    counts = Counter(found.values())
    noticed, reached = sum(counts[status] for status in NOTICED), len(found) - counts["no tests"]
    lines = [
        f"# Mutants of {room}",
        f"`make mutants ROOM={room}`, of {total} changes: {noticed} of {reached} noticed "
        f"({noticed / max(1, reached):.1%}), {counts['timeout']} of them by running out of time; {counts['no tests']} "
        "more are in functions that no test of the folder calls on this machine.",
        *(f"## {name}: {found[name]}\n\n```diff\n{change.strip()}\n```" for name, change in changes.items()),
    ]
    return "\n\n".join(lines) + "\n"


if __name__ == "__main__":
    run_script(Command)
