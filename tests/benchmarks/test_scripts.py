"""The measurement scripts: each is listed, and all handle their options as the commands of `ssa` do."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


def test_the_readme_lists_every_script():
    rows = re.findall(r"^\| `(\w+\.py)` \|.*`python benchmarks/(\w+\.py)", (FOLDER / "README.md").read_text(), re.M)
    assert [listed for listed, _ in rows] == [called for _, called in rows]
    assert sorted(listed for listed, _ in rows) == sorted(path.name for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--help"], 0, "usage: python benchmarks/contact_sheet.py"),
        (["a.png", "--fiel"], 2, "--fiel"),
        (["nowhere/a.png"], 2, "nowhere/a.png cannot be written; name a .png file in a folder that exists"),
    ],
)
def test_a_script_ends_as_a_command_does(arguments, code, said):
    command = [sys.executable, "benchmarks/contact_sheet.py", *arguments]
    done = subprocess.run(command, cwd=FOLDER.parent, capture_output=True, text=True, timeout=100)
    assert done.returncode == code
    assert said in (done.stderr if code else done.stdout)
    assert len(done.stderr.splitlines()) == (1 if code else 0)
