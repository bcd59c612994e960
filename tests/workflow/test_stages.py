"""Stages that write files, interrupted and continued."""

from __future__ import annotations

import io
import json
import logging
from contextlib import nullcontext
from pathlib import Path

import pytest
from rich.console import Console

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.decisions import tell
from ssa_nerfstudio.workflow.stage_display import terminal_display
from ssa_nerfstudio.workflow.stages import FinishedStage, Result, RunRecord, Stage, run_stages


class Shown:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.parts, self.told, self.warned, self.finished = [], [], [], []

    def begin(self, stage: str) -> None:
        self.parts.append(stage)

    def advance(self, stage: str, part: str, done: int, total: int) -> None:
        self.parts.append((stage, part, done, total))

    def tell(self, decision: str) -> None:
        self.told.append(decision)

    def warn(self, warning: str) -> None:
        self.warned.append(warning)

    def finish(self, stage: FinishedStage, earlier: bool) -> None:
        self.finished.append((stage.name, stage.text, stage.warnings, earlier))


@pytest.fixture
def counted(tmp_path):
    """Three stages, the second of which fails as long as there is no file `repaired`; and how often each worked."""
    worked = []

    def work(name: str):
        def do(on_progress) -> Result:
            worked.append(name)
            on_progress("half", 1, 2)
            if name == "b" and not (tmp_path / "repaired").exists():
                raise InputError("b is broken", "repair it")
            return Result(f"{name} is done", ("look",) if name == "c" else ())

        return do

    return [Stage(name, work(name)) for name in "abc"], worked


def test_what_is_done_is_not_repeated(tmp_path, counted):
    stages, worked = counted
    folder = tmp_path / "run"
    folder.mkdir()
    first, second = Shown(), Shown()
    with pytest.raises(InputError, match="b is broken"):
        run_stages(stages, RunRecord(folder / "run.json"), first)
    (tmp_path / "repaired").touch()
    run_stages(stages, RunRecord(folder / "run.json"), second)
    assert worked == ["a", "b", "b", "c"]
    assert first.finished == [("a", "a is done", (), False)]
    assert second.finished == [
        ("a", "a is done", (), True), ("b", "b is done", (), False), ("c", "c is done", ("look",), False),
    ]  # fmt: skip
    assert second.parts == ["b", ("b", "half", 1, 2), "c", ("c", "half", 1, 2)]


def test_what_was_deleted_is_made_again_or_missed(tmp_path):
    folder, worked = tmp_path / "run", []
    folder.mkdir()

    def again(repeatable: bool = True) -> None:
        def do(on_progress) -> Result:
            worked.append("a")
            (folder / "a.txt").touch()
            return Result("done")

        stage = Stage("a", do, leaves=(folder / "a.txt",), repeatable=repeatable)
        run_stages([stage], RunRecord(folder / "run.json"), Shown())

    again()
    again()
    assert worked == ["a"]
    (folder / "a.txt").unlink()
    again()
    assert worked == ["a", "a"]
    (folder / "a.txt").unlink()
    with pytest.raises(InputError, match=r"a.txt, which the run has made, is gone; put it back"):
        again(repeatable=False)
    assert worked == ["a", "a"]


def asked(folder: Path, fails: bool = False, bound: bool = False, **choices) -> None:
    """Run one stage that was asked for something."""

    def do(on_progress) -> Result:
        if fails:
            raise InputError("broken")
        return Result("done")

    folder.mkdir(exist_ok=True)
    run_stages([Stage("a", do, choices, bound)], RunRecord(folder / "run.json"), Shown())


def test_a_finished_stage_is_not_continued_with_other_choices(tmp_path):
    def begun(steps: int = 3, train: tuple[str, ...] = ()) -> None:
        asked(tmp_path / "run", **{"--steps": steps, "--train.": [*train]})

    begun()
    with pytest.raises(InputError, match=r"begun with --steps 3, not --steps 4; repeat"):
        begun(4)
    with pytest.raises(InputError, match=r"begun with no --train\. options, not --train\.vis viewer; repeat"):
        begun(train=("--vis", "viewer"))
    begun()


@pytest.mark.parametrize("bound", [False, True])
def test_a_stage_that_failed_takes_other_choices_unless_it_is_bound(tmp_path, bound):
    with pytest.raises(InputError, match="broken"):
        asked(tmp_path / "run", fails=True, bound=bound, share=0.5)
    if bound:
        with pytest.raises(InputError, match=r"begun with share 0.5, not share 0.4"):
            asked(tmp_path / "run", bound=True, share=0.4)
        return
    asked(tmp_path / "run", share=0.4)
    with pytest.raises(InputError, match=r"begun with share 0.4, not share 0.5"):
        asked(tmp_path / "run", share=0.5)


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "holiday.jpg").touch()
    with pytest.raises(InputError, match="exists and is no run"):
        RunRecord(tmp_path / "run.json")
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]


@pytest.mark.parametrize(
    "text", ["", "[]", json.dumps({"a": {}}), json.dumps({"a": {"choices": {}, "done": {"seconds": 1}}})]
)
def test_a_broken_record(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match="cannot be read"):
        RunRecord(tmp_path / "run.json")


@pytest.mark.parametrize("fails", [False, True])
def test_what_the_library_warns_of_is_shown_at_once_and_kept_with_the_stage(tmp_path, fails):
    """What a stage warned of that failed is forgotten: it will warn again."""

    def do(on_progress) -> Result:
        logging.getLogger("ssa_nerfstudio.sfm").warning("mask it with --mask")
        assert shown.warned == ["mask it with --process.mask"]
        logging.getLogger("ssa_nerfstudio.sfm").warning("mask it with --mask")
        if fails:
            raise InputError("broken")
        return Result("done", ("look",))

    record, shown = tmp_path / "run.json", Shown()
    with nullcontext() if not fails else pytest.raises(InputError):
        run_stages([Stage("process", do)], RunRecord(record), shown)
    warnings = ("look", "mask it with --process.mask")
    assert shown.finished == ([] if fails else [("process", "done", warnings, False)])
    assert json.loads(record.read_text())["process"]["warnings"] == ([] if fails else [warnings[1]])


def test_warnings_outlive_a_stage_that_is_killed_and_not_repeated(tmp_path):
    """As of a dataset that is complete when the process ends before it records the stage."""
    killed = True

    def do(on_progress) -> Result:
        if killed:
            logging.getLogger("ssa_nerfstudio.sfm").warning("two cameras are alike")
            raise KeyboardInterrupt
        return Result("done")

    def run(**choices: object) -> tuple[str, ...]:
        shown = Shown()
        run_stages([Stage("process", do, choices)], RunRecord(tmp_path / "run.json"), shown)
        return shown.finished[-1][2]

    for choices, expected in (({}, ("two cameras are alike",)), ({"share": 0.5}, ())):
        (tmp_path / "run.json").unlink(missing_ok=True)
        killed = True
        with pytest.raises(KeyboardInterrupt):
            run()
        killed = False
        assert run(**choices) == expected


def test_the_screen_shows_a_warning_once():
    console = Console(width=80, record=True, file=io.StringIO())
    with terminal_display(["a"], console) as display:
        display.warn("two cameras [are] alike")
        display.finish(FinishedStage("a", 1.0, "done", ("two cameras [are] alike", "look")), earlier=False)
    lines = console.export_text().split("\n")
    assert [line for line in lines if "warning" in line] == ["warning: two cameras [are] alike", "warning: look"]


def test_what_a_stage_decided_is_told_at_once_and_outlives_a_stop(tmp_path):
    """As of a training that is killed, and then continued without deciding again."""
    stopped = True

    def do(on_progress) -> Result:
        if stopped:
            for _ in range(2):
                tell("Exposure acts on the scene alone.")
            assert json.loads(record.read_text())["train"]["decisions"] == ["Exposure acts on the scene alone."]
            raise InputError("broken")
        return Result("done")

    record, shown = tmp_path / "run.json", Shown()
    with pytest.raises(InputError, match="broken"):
        run_stages([Stage("train", do)], RunRecord(record), shown)
    assert shown.told == ["Exposure acts on the scene alone."] * 2
    stopped = False
    run_stages([Stage("train", do)], RunRecord(record), shown)
    (done,) = RunRecord(record).stages.values()
    assert done.decisions == ("Exposure acts on the scene alone.",)
    assert done.warnings == ()


def test_what_a_stage_wrote_and_lost_is_made_again(tmp_path):
    """Its files are known only when it is done: how many pictures there are depends on what was learned."""

    def do(on_progress) -> Result:
        (tmp_path / "artifact.png").touch()
        return Result("done", files=("artifact.png",))

    for earlier in (False, True, False):
        shown = Shown()
        run_stages([Stage("export", do)], RunRecord(tmp_path / "run.json"), shown)
        assert shown.finished == [("export", "done", (), earlier)]
        if earlier:
            (tmp_path / "artifact.png").unlink()
    assert (tmp_path / "artifact.png").exists()
