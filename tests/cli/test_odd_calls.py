"""No odd input ends in a traceback: one line that names the culprit and exit code 2, or it is worked with."""

from __future__ import annotations

import hashlib
import json
import shlex
import shutil
from collections import Counter
from pathlib import Path

import pytest
from experiments.benchmark.made_results import all_results, folder_of
from export.small_checkpoints import one_camera, write_run
from odd_cases import corpus, edit_checkpoint, edit_json, edit_photo, write

from ssa_nerfstudio._system.terminal_messages import print_error
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.errors import SSAError
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay


def called(*words: object) -> int:
    """Exit code of `ssa ...` in this process; anything but an exit is a traceback, and fails the test."""
    try:
        main([str(word) for word in words])
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    return 0


@pytest.fixture
def readers(tmp_path, configure_training):
    def train(data: Path) -> int:
        model = {"overlay": "on", "overlay_start": "constant"}
        config = configure_training("ssa-splatfacto", data, tmp_path / "runs", 2, model)
        try:
            config.set_timestamp()
            config.setup(local_rank=0, world_size=1).setup()
        except SSAError as error:  # as plugin/command_entry.py does it for ns-train
            return print_error(error)
        return 0

    out = tmp_path / "out"
    return {
        "detect": lambda data: called("detect", "--data", data, "--output", out, "--threads", 1),
        "simulate": lambda data: called(
            "simulate", "--data", data, "--output", out, "--effects", "vignette", "--threads", 1
        ),
        "train": train,
        "export": lambda data: called("export-dataset", "--data", data, "--output", out, "--for", "colmap"),
    }


def contents(folder: Path) -> dict[str, str]:
    """Hash of every file, by path."""
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


def in_turn(cases: list[dict], readers: tuple[str, ...], kept: int) -> list:
    """Each case for `kept` readers, and for the others among the slow tests.

    Readers take turns, but one of each answer that is expected comes before the second of any.
    """
    chosen = []
    for number, case in enumerate(cases):
        first, before = number % len(readers), Counter()
        ranked = []
        for reader in readers[first:] + readers[:first]:
            ranked.append((before[answer(case, reader)], reader))
            before[answer(case, reader)] += 1
        for turn, (_, reader) in enumerate(sorted(ranked, key=lambda pair: pair[0])):
            marks = () if turn < kept else pytest.mark.slow
            chosen.append(pytest.param(case, reader, id=f"{case['case']}-{reader}", marks=marks))
    return chosen


def answer(case: dict, reader: str) -> str | None:
    """What the error line has to say to a reader; None: it works with the case."""
    if reader in case.get("taken_by", ()):
        return None
    return case.get(f"says to {reader}", case.get("says"))


READERS = ("detect", "simulate", "train", "export")


@pytest.mark.parametrize(("case", "reader"), in_turn(corpus("transforms"), READERS, 2))
def test_an_odd_transforms_json(case, reader, readers, broken_scene, tmp_path, capsys):
    edit_json(broken_scene / "transforms.json", case)
    for name, content in case.get("beside", {}).items():
        (broken_scene / name).unlink(missing_ok=True)
        write(broken_scene / name, content)
    code = readers[reader](broken_scene)
    judge(case, reader, code, capsys.readouterr().err, tmp_path)


EXPORTS = {
    "export-overlay": ["--output"],
    "export-splats": ["--compressed", "--output-dir"],
}


@pytest.mark.parametrize("command", EXPORTS)
@pytest.mark.parametrize("case", corpus("checkpoints"), ids=lambda case: case["case"])
def test_an_odd_checkpoint(case, command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    config = write_run(tmp_path / "run", one_camera(ScreenSpaceOverlay(20, 30)))
    edit_checkpoint(tmp_path / "run/nerfstudio_models/step-000000009.ckpt", case)
    code = called(command, "--load-config", config, *EXPORTS[command], tmp_path / "out")
    judge(case, command, code, capsys.readouterr().err, tmp_path)
    assert not Path("hostile-code-ran").exists()


PHOTO_READERS = (*READERS, "detect photos", "process", "export-overlay")


@pytest.mark.parametrize(("case", "reader"), in_turn(corpus("photos"), PHOTO_READERS, 3))
def test_an_odd_photo(case, reader, readers, broken_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for path in (broken_scene / "images").glob("test_*"):
        path.rename(broken_scene / path.name)
    edit_json(broken_scene / "transforms.json", {"unsplit": True})
    content = json.loads((broken_scene / "transforms.json").read_text())
    content["frames"] = [frame for frame in content["frames"] if "train" in frame["file_path"]]
    (broken_scene / "transforms.json").write_text(json.dumps(content))
    edit_photo(broken_scene / "images/train_0003.png", case)
    photos, out = broken_scene / "images", tmp_path / "out"
    if reader == "detect photos":
        code = called("detect", "--data", photos, "--output", out, "--threads", 1)
    elif reader == "process":
        code = called("process", "--train", photos, "--output", out, "--threads", 1)
        if "says" not in case or reader in case.get("taken_by", ()):
            case = {"says": "photos could be registered"}  # these are too small
    elif reader == "export-overlay":
        config = write_run(tmp_path / "run", one_camera(ScreenSpaceOverlay(48, 64)))
        code = called("export-overlay", "--load-config", config, "--output", out, "--apply", photos)
    else:
        code = readers[reader](broken_scene)
    judge(case, reader, code, capsys.readouterr().err, tmp_path)
    assert not Path("hostile-code-ran").exists()


@pytest.fixture(scope="session")
def inputs(tiny_scene, tmp_path_factory) -> dict[str, str]:
    """What the calls name. Read only."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "text.txt").write_text("text")
    named = shutil.copytree(tiny_scene, folder / "named")
    (named / "images/train_0003.png").rename(named / "images/\udcff.png")
    text = (named / "transforms.json").read_text()
    (named / "transforms.json").write_text(text.replace("train_0003.png", r"\udcff.png"))
    runs = [each for each in all_results() if each.run.scene == "attic" and each.run.seed == 0]
    return {
        "scene": str(shutil.copytree(tiny_scene, folder / "scene")),
        "named": str(named),
        "photos": str(folder / "scene/images"),
        "run": str(folder / "run"),
        "config": str(write_run(folder / "run", one_camera(ScreenSpaceOverlay(48, 64)))),
        "results": str(folder_of(folder / "results", runs)),
        "file": str(folder / "text.txt"),
        "long": "a" * 5000,
        "digits": "9" * 5000,
        "space": "my photos",
        "bytes": "x\udcff",
    }


@pytest.mark.parametrize("case", corpus("calls"), ids=lambda case: case["call"])
def test_an_odd_call(case, inputs, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "here"
    for name, text in {"there.txt": "", **case.get("files", {})}.items():
        write(folder / name, text)
    for name, target in case.get("links", {}).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(target.format(**inputs))
    monkeypatch.chdir(folder)
    for name, value in case.get("environment", {}).items():
        monkeypatch.setenv(name, value)
    before = contents(Path(inputs["file"]).parent)
    there = {path.name for path in folder.iterdir()}
    code = called(*(word.format(**inputs) for word in shlex.split(case["call"])))
    out, err = capsys.readouterr()
    judge(case, "", code, err, tmp_path)
    assert case.get("prints", "") in out
    assert "" not in [line.strip() for line in out.splitlines()][:1], "it begins with an empty line"
    assert {path.name for path in folder.iterdir()} - there == {*case.get("after", [])}
    assert contents(Path(inputs["file"]).parent) == before


def judge(case, reader, code, err, tmp_path):
    expected = answer(case, reader)
    lines = [line for line in err.splitlines() if line.startswith("ssa-nerfstudio: error")]
    if expected is not None:
        assert code == 2, "was taken"
        assert len(lines) == 1, err
        assert expected in lines[0]
        assert not (tmp_path / "out").exists()
    else:
        assert (code, lines) == (0, [])
