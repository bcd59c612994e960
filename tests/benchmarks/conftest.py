"""Measurement scripts, called in this process."""

from __future__ import annotations

import os
import runpy
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def call(monkeypatch, capsys):
    """Call a script as a process would, which has the script's folder on its path: exit code, output and errors."""
    for imported in [each for each in sys.modules if each.partition(".")[0] == "benchmarks"]:
        monkeypatch.delitem(sys.modules, imported)
    monkeypatch.setitem(sys.modules, "benchmarks", None)  # cannot be imported
    monkeypatch.syspath_prepend(FOLDER)

    def called(name: str, *arguments: str) -> tuple[int | str | None, str, str]:
        path = os.path.relpath(FOLDER / name)
        monkeypatch.setattr(sys, "argv", [path, *arguments])
        try:
            runpy.run_path(path, run_name="__main__")
        except SystemExit as end:
            return end.code, *capsys.readouterr()
        return 0, *capsys.readouterr()

    return called
