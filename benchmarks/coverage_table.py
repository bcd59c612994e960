"""Branch coverage by folder, from pytest-cov's JSON: `python benchmarks/coverage_table.py coverage.json`."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import NotNegative
from ssa_nerfstudio.errors import InputError

COUNTS = ("num_statements", "covered_lines", "num_branches", "covered_branches")
"""Numbers that coverage.py states of each file."""


@dataclass
class Command:
    """Print a table of statements and branches that tests take, and of the files with most branches that none takes."""

    report: Annotated[Path, tyro.conf.Positional]
    """Written by `pytest --cov ssa_nerfstudio --cov-branch --cov-report json:FILE`."""
    files: NotNegative = 12
    """How many files to list."""

    def run(self) -> None:
        """Print as Markdown.

        Raises:
            InputError: the file cannot be read.
        """
        try:
            files = json.loads(self.report.read_text(encoding="utf-8"))["files"]
            rows = {Path(name): Counter({key: each["summary"][key] for key in COUNTS}) for name, each in files.items()}
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise InputError(f"{self.report} cannot be read ({error})", "give pytest-cov's JSON") from error
        folders: dict[str, Counter[str]] = {}
        for path, counts in rows.items():
            parts = path.parts[path.parts.index("ssa_nerfstudio") + 1 :]
            name = "/".join(parts[:2]) if parts[:2] == ("plugin", "training") else parts[0] if parts[1:] else "(top)"
            folders.setdefault(name, Counter()).update(counts)
        folders["all"] = sum(rows.values(), Counter())
        print("| folder | statements | run | branches | taken |", "|---|---|---|---|---|", sep="\n")
        for name, counts in sorted(folders.items()):
            print(f"| {name} | {' | '.join(_cells(counts))} |")
        left = {path: counts["num_branches"] - counts["covered_branches"] for path, counts in rows.items()}
        print("", "| file | branches not taken | lines |", "|---|---|---|", sep="\n")
        for path in sorted(left, key=left.__getitem__, reverse=True)[: self.files]:
            lines = files[str(path)].get("missing_lines", [])
            print(f"| {path} | {left[path]} | {', '.join(map(str, lines[:20]))} |")


def _cells(counts: Counter[str]) -> list[str]:
    cells = []
    for total, taken in zip(COUNTS[::2], COUNTS[1::2], strict=True):
        cells += [f"{counts[total]}", f"{counts[taken] / max(1, counts[total]):.0%}"]
    return cells


if __name__ == "__main__":
    run_script(Command)
