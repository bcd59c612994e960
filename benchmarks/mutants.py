"""Which changes of meaning the tests of a folder notice: `python benchmarks/mutants.py --room overlay`."""

from __future__ import annotations

import filecmp
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.errors import InputError

ROOT = Path(__file__).parents[1]
SETTINGS = """
[tool.mutmut]
source_paths = ["ssa_nerfstudio"]
only_mutate = ["ssa_nerfstudio/{room}/*"]
pytest_add_cli_args_test_selection = ["tests/{room}"]
also_copy = ["configs"]
# Forks of a process in which torch and numba have computed hang.
process_isolation = "forkserver"
"""


@dataclass
class Command:
    """Change a folder of the package one line at a time, and write which changes its tests do not notice."""

    room: str = "overlay"
    """Folder below ssa_nerfstudio, and below tests: overlay, evidence, plugin/training, ..."""
    output: Path = Path("build/mutants")
    """Folder to work in. A stopped run continues; mutants of functions that have changed are tried anew."""
    children: int = len(os.sched_getaffinity(0))
    """Mutants tried at once."""

    def run(self) -> None:
        """Try what is left, and write OUTPUT/ROOM.md.

        Raises:
            InputError: there is no such folder, or its tests fail without a mutant.
        """
        for kind in ("ssa_nerfstudio", "tests"):
            if not (ROOT / kind / self.room).is_dir():
                raise InputError(f"there is no folder {kind}/{self.room}", "name one below both")
        folder = self.output / self.room
        _copy(folder, self.room)
        mutmut = [sys.executable, "-m", "mutmut"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        tried = subprocess.run([*mutmut, "run", "--max-children", str(self.children)], cwd=folder, env=environment)
        if tried.returncode:
            raise InputError(f"the tests of {self.room} fail as they are", f"pytest tests/{self.room} says why")

        def told(*words: str) -> str:
            return subprocess.run([*mutmut, *words], cwd=folder, capture_output=True, text=True, check=True).stdout

        found = dict(re.findall(r"^ +(\S+): (.+)$", told("results", "--all", "true"), re.MULTILINE))
        page = self.output / f"{self.room.replace('/', '-')}.md"
        page.write_text(_page(self.room, found, {name: told("show", name) for name in _survivors(found)}))
        print(page)


def _survivors(found: dict[str, str]) -> list[str]:
    return [name for name, status in found.items() if status == "survived"]


def _copy(folder: Path, room: str) -> None:
    """Copy what has changed, so that what was tried stays known."""
    for kind in ("ssa_nerfstudio", "configs", "tests"):
        for path in (ROOT / kind).rglob("*"):
            place = folder / path.relative_to(ROOT)
            if path.is_file() and "__pycache__" not in path.parts:
                place.parent.mkdir(parents=True, exist_ok=True)
                if not place.exists() or not filecmp.cmp(path, place, shallow=False):
                    shutil.copy(path, place)
    settings = (ROOT / "pyproject.toml").read_text() + SETTINGS.format(room=room)
    (folder / "pyproject.toml").write_text(settings)


def _page(room: str, found: dict[str, str], changes: dict[str, str]) -> str:
    counts = Counter(found.values())
    noticed, reached = counts["killed"] + counts["timeout"], len(found) - counts["no tests"]
    lines = [
        f"# Mutants of {room}",
        f"`make mutants ROOM={room}`: {noticed} of {reached} noticed ({noticed / max(1, reached):.1%}); "
        f"{counts['no tests']} in functions that no test of the folder calls on this machine.",
        *(f"## {name}\n\n```diff\n{change.strip()}\n```" for name, change in changes.items()),
    ]
    return "\n\n".join(lines) + "\n"


if __name__ == "__main__":
    run_script(Command)
