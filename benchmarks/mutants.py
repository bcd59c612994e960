"""Which changes of meaning the tests of a folder notice: `python benchmarks/mutants.py --room overlay`."""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from mutation.undecorated import undecorated

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.errors import InputError

ROOT = Path(__file__).parents[1]
SETTINGS = """
[tool.mutmut]
source_paths = ["ssa_nerfstudio"]
only_mutate = ["ssa_nerfstudio/{room}/*"]
# The seconds that a test of speed takes say nothing about a mutant.
pytest_add_cli_args_test_selection = ["tests/{room}", "-k", "not speed"]
also_copy = ["configs", "benchmarks"]
# Forks of a process in which torch and numba have computed hang.
process_isolation = "forkserver"
# With the default of a few seconds, most of which tests need to be collected, mutants seem to hang on a busy machine.
timeout_constant = 30.0
timeout_multiplier = 4.0
"""
GENERATE = """
from mutmut import __main__ as mutmut
mutmut.makedirs("mutants", exist_ok=True)
mutmut.copy_src_dir()
mutmut.copy_also_copy_files()
mutmut.create_mutants(1)
"""
NOTICED = ("killed", "timeout", "segfault", "suspicious")  # the last: any other exit code, such as that of an abort
KNOWN = ("killed", "segfault", "suspicious")
"""Verdicts that stand; others are tried again, because tests may have been added since."""


ALL = "all"
"""The whole package: every folder of it that has tests, each changed and tested by itself."""


@dataclass
class Command:
    """Change a folder of the package one line at a time, and write which changes its tests do not notice."""

    room: str = "overlay"
    """Folder below ssa_nerfstudio, and below tests: overlay, evidence, plugin/training, ...; or all of them: all."""
    output: Path = Path("build/mutants")
    """Folder to work in. A stopped run continues; survivors and mutants of changed functions are tried anew."""
    children: int = len(os.sched_getaffinity(0))
    """Mutants tried at once."""
    sample: int = 0
    """Try so many, drawn at random from all changes that are asked for; 0: all."""
    seed: int = 0
    """Of the sample."""

    def run(self) -> None:
        """Try what is left, and write OUTPUT/ROOM.md.

        Raises:
            InputError: there is no such folder, or its tests fail without a mutant.
        """
        rooms = [Room(name, self.output.resolve() / name) for name in self._names()]
        before = {room: room.prepared() for room in rooms}
        every = [(room, change) for room in rooms for change in sorted(before[room])]
        chosen = random.Random(self.seed).sample(every, min(self.sample, len(every))) if self.sample else every
        tried: dict[str, str] = {}
        shown: dict[str, str] = {}
        for room in rooms:
            changes = [change for of, change in chosen if of == room]
            if todo := [change for change in changes if before[room][change] not in KNOWN]:
                room.try_changes(todo, self.children)
            after = room.found() if todo else before[room]
            tried |= {change: after[change] for change in changes}
            shown |= {name: room.told("show", name) for name in changes if after[name] in ("survived", "timeout")}
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


@dataclass(frozen=True)
class Room:
    """A folder of the package whose changes its own tests are to notice."""

    name: str
    folder: Path
    """Where a copy of the package lies, and mutmut keeps what it found."""

    def prepared(self) -> dict[str, str]:
        """Copy the package, make all changes of the folder, and return what is known of each."""
        _copy(self.folder, self.name)
        subprocess.run([sys.executable, "-c", GENERATE], cwd=self.folder, check=True, stdout=subprocess.DEVNULL)
        return self.found()

    def told(self, *words: str) -> str:
        """What a command of mutmut prints."""
        command = [sys.executable, "-m", "mutmut", *words]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=True).stdout

    def found(self) -> dict[str, str]:
        """The verdict on each change."""
        return dict(re.findall(r"^ +(\S+): (.+)$", self.told("results", "--all", "true"), re.MULTILINE))

    def try_changes(self, names: list[str], children: int) -> None:
        """Run the tests of each.

        Raises:
            InputError: they fail without a change.
        """
        # What is tested comes before what is installed, also in processes that tests start.
        path = str(self.folder / "mutants")
        environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "mutmut", "run", "--max-children", str(children), *names]
        if subprocess.run(command, cwd=self.folder, env=environment).returncode:
            raise InputError(f"the tests of {self.name} fail as they are", f"pytest tests/{self.name} says why")


def _copy(folder: Path, room: str) -> None:
    """Copy what has changed, so that what was tried stays known."""
    for kind in ("ssa_nerfstudio", "configs", "tests", "benchmarks"):
        for path in (ROOT / kind).rglob("*"):
            place = folder / path.relative_to(ROOT)
            if path.is_file() and "__pycache__" not in path.parts:
                content = path.read_bytes()
                if path.is_relative_to(ROOT / "ssa_nerfstudio" / room) and path.suffix == ".py":
                    content = undecorated(content.decode()).encode()
                place.parent.mkdir(parents=True, exist_ok=True)
                if not place.exists() or place.read_bytes() != content:
                    place.write_bytes(content)
    settings = (ROOT / "pyproject.toml").read_text() + SETTINGS.format(room=room)
    (folder / "pyproject.toml").write_text(settings)


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
