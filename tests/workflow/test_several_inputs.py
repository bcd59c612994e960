"""`ssa run` with several files or folders where it takes one."""

from __future__ import annotations

import pytest

from ssa_nerfstudio.cli import main


def run(*options: object) -> None:
    main(["run", *map(str, options)])


def test_a_list_of_photos_is_answered_with_their_folder(tiny_scene, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run(*sorted((tiny_scene / "images").iterdir()), "--output", tmp_path / "out")
    assert f"give {tiny_scene / 'images'}" in capsys.readouterr().err


def test_folders_of_a_rig_are_answered_with_the_folder_that_holds_them(tmp_path, capsys):
    for name in ("front", "side", "out"):
        (tmp_path / name).mkdir()
    with pytest.raises(SystemExit):
        run(tmp_path / "front", tmp_path / "side", "--output", tmp_path / "out")
    assert f"not 2 folders; give {tmp_path}, whose subfolders are its cameras" in capsys.readouterr().err
