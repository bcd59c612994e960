"""Files and folders appear whole or not at all."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ssa_nerfstudio.data import writing
from ssa_nerfstudio.data.writing import staged_file, staged_files, staged_folder, unwritable_as_input_error, write_text
from ssa_nerfstudio.errors import InputError


class Interrupted(Exception):
    """As a signal would."""


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_folder_appears_at_the_end(tmp_path):
    with staged_folder(tmp_path / "new" / "out") as folder:
        (folder / "file").write_text("content")
        assert not (tmp_path / "new" / "out").exists()
    assert names(tmp_path) == ["new", "new/out", "new/out/file"]


def test_nothing_of_a_folder_is_left_after_an_error(tmp_path):
    with pytest.raises(Interrupted), staged_folder(tmp_path / "out") as folder:  # noqa: PT012 - the block is the test
        (folder / "file").write_text("content")
        raise Interrupted
    assert names(tmp_path) == []


def test_an_earlier_folder_is_replaced_at_the_end_or_stays(tmp_path):
    output = tmp_path / "out"
    for content in ("first", "second"):
        with staged_folder(output, replaces=True) as folder:
            (folder / content).write_text(content)
            assert names(output) == ([] if content == "first" else ["first"])
    with pytest.raises(Interrupted), staged_folder(output, replaces=True) as folder:
        raise Interrupted
    assert names(tmp_path) == ["out", "out/second"]
    with pytest.raises(InputError, match="cannot be written"), staged_folder(output, replaces=True) as folder:
        folder.rmdir()  # the swap fails half-way
    assert names(tmp_path) == ["out", "out/second"]
    (file := tmp_path / "file").write_text("content")
    with pytest.raises(InputError, match="exists already"), staged_folder(file, replaces=True):
        pass


def test_a_folder_that_exists_or_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"exists already; remove it"), staged_folder(tmp_path):
        pass
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match="file is a file; choose"),
        staged_folder(tmp_path / "file" / "out"),
    ):
        pass


def test_a_file_is_replaced_at_the_end_or_stays_as_it_was(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    with pytest.raises(Interrupted), staged_file(path) as part:  # noqa: PT012
        part.write_text("half")
        raise Interrupted
    assert path.read_text() == "old"
    with staged_file(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert names(tmp_path) == ["file"]


def test_what_a_killed_process_left_is_overwritten(tmp_path):
    (tmp_path / ".file.part").write_text("half of an earlier attempt")
    with staged_file(tmp_path / "file") as part, part.open("a") as file:
        file.write("new")
    assert (tmp_path / "file").read_text() == "new"
    assert names(tmp_path) == ["file"]


def test_what_another_process_begins_once_a_file_is_written_stays(tmp_path, monkeypatch):
    replace = Path.replace

    def replace_and_go_on(part: Path, path: Path) -> None:
        replace(part, path)
        part.write_text("of the next")

    monkeypatch.setattr(Path, "replace", replace_and_go_on)
    with staged_file(tmp_path / "file"):
        pass
    assert names(tmp_path) == [".file.part", "file"]


KILLED = """
import os, sys
from pathlib import Path
from ssa_nerfstudio.data.writing import staged_folder
with staged_folder(Path(sys.argv[1])) as folder:
    (folder / "file").write_text("half")
    print("at work", flush=True)
    sys.stdin.read()
    os._exit(1)
"""


def test_a_folder_that_a_killed_process_left_is_removed_by_the_next_and_not_before(tmp_path):
    (tmp_path / ".out.notes123").mkdir()
    (tmp_path / ".out.notes123.part").mkdir()
    (tmp_path / ".out.notes123.part" / "mine").write_text("of somebody else")
    kept = names(tmp_path)
    command = [sys.executable, "-c", KILLED, tmp_path / "out"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as at_work:
        assert at_work.stdout is not None
        assert at_work.stdout.readline() == b"at work\n"
        with staged_folder(tmp_path / "out") as folder:
            assert len(names(tmp_path)) == len(kept) + 5
        folder = tmp_path / "out"
        assert len(names(tmp_path)) == len(kept) + 4
        folder.rmdir()
    assert len(names(tmp_path)) == len(kept) + 3
    with staged_folder(tmp_path / "out"):
        pass
    assert names(tmp_path) == sorted([*kept, "out"])


def test_a_lock_of_the_user_on_the_folder_above_is_not_waited_for_for_ever(tmp_path, monkeypatch):
    """As in `flock . ssa simulate --output out`."""
    monkeypatch.setattr(writing, "_PATIENCE", 0.05)
    (tmp_path / ".out.abcdefgh.part").mkdir()
    descriptor = os.open(tmp_path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        with staged_folder(tmp_path / "out") as folder:
            (folder / "file").write_text("")
    finally:
        os.close(descriptor)
    assert names(tmp_path) == [".out.abcdefgh.part", "out", "out/file"]  # what could be another's stays


def test_an_earlier_folder_that_a_killed_process_was_replacing_is_kept(tmp_path):
    earlier = tmp_path / ".out.abcdefgh.part" / "out.earlier"
    earlier.mkdir(parents=True)
    with staged_folder(tmp_path / "out"):
        pass
    assert earlier.is_dir()


def test_a_file_that_another_process_is_writing_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    with staged_file(path) as part:
        part.write_text("first")
        with pytest.raises(InputError, match=r"another process is writing .*a.ply; wait until it ends"):
            write_text(path, "second")
    assert path.read_text() == "first"
    write_text(path, "third")
    assert (path.read_text(), names(tmp_path)) == ("third", ["a.ply"])


def test_where_the_file_system_has_no_locks_files_and_folders_are_written_all_the_same(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", refuse)
    (tmp_path / ".out.abcdefgh.part").mkdir()
    write_text(tmp_path / "a.json", "{}")
    with staged_folder(tmp_path / "out"):
        pass
    assert names(tmp_path) == [".out.abcdefgh.part", "a.json", "out"]


def test_several_files_appear_at_the_end_and_none_after_an_error(tmp_path):
    folder, scratch = tmp_path / "folder", tmp_path / "scratch"
    scratch.mkdir()
    (scratch / "left by a killed process").write_text("")
    with staged_files(folder, scratch) as staged:
        (staged / "one").write_text("1")
        (staged / "two").write_text("2")
        assert not folder.exists()
    assert names(tmp_path) == ["folder", "folder/one", "folder/two"]
    with pytest.raises(Interrupted), staged_files(folder, scratch) as staged:  # noqa: PT012
        (staged / "three").write_text("3")
        raise Interrupted
    assert names(tmp_path) == ["folder", "folder/one", "folder/two"]


def test_errors_of_the_system_name_the_output(tmp_path):
    with (
        pytest.raises(InputError, match=r"out cannot be written .*; free space there"),
        unwritable_as_input_error(tmp_path / "out"),
    ):
        raise OSError(28, "No space left on device")
    with pytest.raises(InputError, match=r"nowhere/a.json cannot be written"):
        write_text(tmp_path / "nowhere" / "a.json", "{}")


def test_text_goes_to_files_and_to_standard_output(tmp_path):
    write_text(tmp_path / "a.json", "{}")
    assert names(tmp_path) == ["a.json"]
    program = "from pathlib import Path; from ssa_nerfstudio.data.writing import write_text;"
    program += "write_text(Path('/dev/stdout'), 'text')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "text"
    with (tmp_path / "redirected").open("w") as file:
        subprocess.run([sys.executable, "-c", program], stdout=file, check=True)
    assert (tmp_path / "redirected").read_text() == "text"
