"""A folder is locked by one process at a time."""

from __future__ import annotations

import subprocess
import sys

import pytest

from ssa_nerfstudio._system.file_lock import LOCK, locked_folder
from ssa_nerfstudio.errors import InputError

HOLD = """
import sys
from pathlib import Path
from ssa_nerfstudio._system.file_lock import locked_folder
with locked_folder(Path(sys.argv[1]), "ssa test"):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_a_folder_that_another_process_holds_is_refused_until_that_is_killed(tmp_path):
    folder = tmp_path / "new" / "folder"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    assert holder.stdin is not None
    assert holder.stdout.readline() == "locked\n"
    with pytest.raises(InputError, match="another ssa test is at work in"), locked_folder(folder, "ssa test"):
        pass
    holder.kill()
    holder.wait()
    holder.stdin.close()
    holder.stdout.close()
    with locked_folder(folder, "ssa test"):
        assert (folder / LOCK).is_file()


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"), locked_folder(tmp_path / "file" / "folder", "ssa test"):
        pass
