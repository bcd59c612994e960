"""Text is read up to a size, and from files alone."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ssa_nerfstudio._system.text_files import MAX_BYTES, read_text
from ssa_nerfstudio.errors import InputError


def test_text_of_the_largest_size_is_read_and_no_more(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("grün", encoding="utf-8")
    assert read_text(path, 5) == "grün"
    with pytest.raises(InputError, match=r"a.json has 0 MB and is not read; such files have at most 0 MB$"):
        read_text(path, 4)


def test_what_is_beyond_a_large_dataset_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "a.json"
    path.touch()
    os.truncate(path, MAX_BYTES + 1)
    with pytest.raises(InputError, match=r"a.json has 410 MB .* at most 410 MB, enough for 100,000 photos"):
        read_text(path)


def test_devices_and_pipes_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.json")
    with pytest.raises(InputError, match=r"a.json cannot be read \(it is a pipe\)"):
        read_text(tmp_path / "a.json")
    (tmp_path / "b.json").symlink_to("/dev/zero")
    with pytest.raises(InputError, match=r"b.json cannot be read \(it is a device\)"):
        read_text(tmp_path / "b.json")
    with pytest.raises(FileNotFoundError):
        read_text(Path("nowhere"))
