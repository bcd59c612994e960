"""Stages that run one after the other; those that an earlier run finished are not repeated."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.data.writing import write_text
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.sfm.progress_display import ProgressCallback
from ssa_nerfstudio.workflow.typed_options import errors_for_run, typed_for_run


@dataclass(frozen=True)
class Result:
    """What a stage says when it is done."""

    text: str
    """What came out, in one sentence without a period."""
    warnings: tuple[str, ...] = ()
    """What the user should know, each with its remedy."""
    files: tuple[str, ...] = ()
    """What it has written beside `Stage.leaves`, relative to the run's folder."""


@dataclass(frozen=True)
class Stage:
    """One step on the way. Its work may find its own output, complete or not, of a run that was killed."""

    name: str
    work: Callable[[ProgressCallback], Result]
    choices: dict[str, Any] = field(default_factory=dict)
    """What it depends on, JSON values by the name of the option."""
    bound: bool = False
    """Whether the choices are fixed as soon as it has begun, not only when it is done."""
    leaves: tuple[Path, ...] = ()
    """Files and folders that are there when it is done."""
    repeatable: bool = True
    """Whether it can be done again, with the same outcome for later stages, where something it left is gone."""


@dataclass(frozen=True)
class FinishedStage:
    """A stage of the record."""

    name: str
    seconds: float
    """Of the attempt that finished it."""
    text: str
    warnings: tuple[str, ...] = ()
    decisions: tuple[str, ...] = ()
    """What it decided by itself while it worked, in sentences."""
    files: tuple[str, ...] = ()
    """See `Result.files`."""


class StageDisplay(Protocol):
    """What shows the progress."""

    def begin(self, stage: str) -> None:
        """A stage starts to work."""

    def advance(self, stage: str, part: str, done: int, total: int) -> None:
        """Part of a stage: how many items are done, and how many there are."""

    def tell(self, decision: str) -> None:
        """What a stage decided by itself, while it works."""

    def warn(self, warning: str) -> None:
        """What the user should know, while a stage works; it is also among the finished stage's."""

    def finish(self, stage: FinishedStage, earlier: bool) -> None:
        """A stage is done, in this run or an earlier one."""


class RunRecord:
    """`run.json`: the stages that have begun, what each was asked for, what it decided and warned of, and what came
    out.

    Decisions and warnings are written at once: work that is continued after a kill does not repeat all of them.
    """

    def __init__(self, path: Path) -> None:
        """Read or start the record.

        Args:
            path: the file, in a folder that exists.

        Raises:
            InputError: the file is no record, the folder has other contents, or it cannot be written.
        """
        self._path = path
        self.stages: dict[str, FinishedStage] = {}
        self._choices: dict[str, dict[str, Any]] = {}
        self._decisions: dict[str, list[str]] = {}
        self._warnings: dict[str, list[str]] = {}
        check_run_folder(path)
        if not path.exists():
            self._write()
            return
        try:
            for name, entry in json.loads(read_text(path)).items():
                self._choices[name] = dict(entry["choices"])
                decided = self._decisions[name] = list(entry.get("decisions", []))
                self._warnings[name] = list(entry.get("warnings", []))
                if done := entry["done"]:
                    sequences = {key: tuple(done.get(key, ())) for key in ("warnings", "files")}
                    known = {**done, **sequences, "decisions": tuple(decided)}
                    self.stages[name] = FinishedStage(name, **known)
        except InputError:
            raise
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"{path} cannot be read ({error})", "choose another --output") from error

    def check(self, stages: Sequence[Stage]) -> None:
        """Check that stages are asked for what their part of the record was.

        Raises:
            InputError: one is not.
        """
        for stage in stages:
            former = self._choices.get(stage.name)
            if former is None or not (stage.bound or stage.name in self.stages):
                continue
            for name, choice in stage.choices.items():
                if former.get(name) != choice:
                    raise InputError(
                        f"{self._path.parent} was begun with {_words(name, former.get(name))}, not "
                        f"{_words(name, choice)}",
                        "repeat what it was begun with to continue, or choose another --output",
                    )

    def begin(self, stage: Stage) -> None:
        """Record what a stage is asked for; what it warned of when it was asked for something else is forgotten."""
        if self._choices.get(stage.name) != stage.choices:
            self._warnings.pop(stage.name, None)
        self._choices[stage.name] = stage.choices
        self._write()

    def left(self, stage: Stage) -> list[Path]:
        """Files and folders that are there if the stage is done."""
        done = self.stages.get(stage.name)
        return [*stage.leaves, *(self._path.parent / file for file in (done.files if done else ()))]

    def decide(self, name: str, decision: str) -> None:
        """Record what a stage decided."""
        self._note(self._decisions.setdefault(name, []), decision)

    def warn(self, name: str, warning: str) -> None:
        """Record what a stage warned of."""
        self._note(self._warnings.setdefault(name, []), warning)

    def warnings(self, name: str) -> list[str]:
        """What a stage warned of so far, each once."""
        return [*self._warnings.get(name, [])]

    def fail(self, name: str) -> None:
        """Forget what a stage warned of that failed: the next attempt warns by itself."""
        self._warnings.pop(name, None)
        self._write()

    def finish(self, stage: FinishedStage) -> None:
        """Record what came out of a stage."""
        self.stages[stage.name] = replace(stage, decisions=tuple(self._decisions.get(stage.name, [])))
        self._write()

    def _note(self, noted: list[str], text: str) -> None:
        if text not in noted:
            noted.append(text)
            self._write()

    def _write(self) -> None:
        contents = {}
        for name, choices in self._choices.items():
            done = asdict(self.stages[name]) if name in self.stages else {}
            contents[name] = {
                "choices": choices,
                "decisions": self._decisions.get(name, []),
                "warnings": self._warnings.get(name, []),
                "done": {key: done[key] for key in done if key not in ("name", "decisions")},
            }
        write_text(self._path, json.dumps(contents, indent=1) + "\n")


def check_run_folder(record: Path) -> None:
    """Check that a folder is a run's, new or empty.

    Args:
        record: its run.json.

    Raises:
        InputError: it has other contents.
    """
    folder = record.parent
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file", "choose another --output")
    if folder.exists() and not record.exists() and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise InputError(f"{folder} exists and is no run", "choose another --output")


def run_stages(stages: Sequence[Stage], record: RunRecord, display: StageDisplay) -> None:
    """Run the stages that the record lacks, in order.

    Raises:
        SSAError: of a stage.
        InputError: a stage was begun with other choices, or what it left is gone and it cannot be repeated.
    """
    record.check(stages)
    for stage in stages:
        gone = [path for path in record.left(stage) if not path.exists()]
        earlier = stage.name in record.stages and not (gone and stage.repeatable)
        if earlier and gone:
            raise InputError(f"{gone[0]}, which the run has made, is gone", "put it back, or choose another --output")
        if not earlier:
            display.begin(stage.name)
            record.begin(stage)
            start = time.perf_counter()

            result = _worked(stage, record, display)
            seconds = time.perf_counter() - start
            warnings = tuple(dict.fromkeys((*result.warnings, *record.warnings(stage.name))))
            record.finish(FinishedStage(stage.name, seconds, result.text, warnings, files=result.files))
        display.finish(record.stages[stage.name], earlier)


def _worked(stage: Stage, record: RunRecord, display: StageDisplay) -> Result:
    """Let a stage work; what the library logs meanwhile is recorded and shown at once."""

    def told(message: str, is_warning: bool) -> None:
        message = typed_for_run(message, stage.name)
        if is_warning:
            record.warn(stage.name, message)
            display.warn(message)
        else:
            record.decide(stage.name, message)
            display.tell(message)

    try:
        with errors_for_run(stage.name), _heard(told):
            return stage.work(partial(display.advance, stage.name))
    except Exception:
        record.fail(stage.name)
        raise


@contextmanager
def _heard(on_message: Callable[[str, bool], None]) -> Iterator[None]:
    """Hand over what the library logs: level INFO, which is what it decided (`plugin.decisions`), and warnings.

    Args:
        on_message: called with the text and whether it is a warning.
    """

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            text = getattr(record, "brief", record.getMessage())
            on_message(text, record.levelno >= logging.WARNING)

    logger = logging.getLogger("ssa_nerfstudio")
    listeners: list[logging.Handler] = [Listener(logging.INFO)]
    former, logger.handlers = logger.handlers, listeners
    level = logger.level
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.handlers = former
        logger.setLevel(level)


def _words(name: str, choice: object) -> str:
    """A choice as it is typed: options of other commands, a list, carry the prefix that their name is."""
    if isinstance(choice, list):
        words = [f"{name}{word.removeprefix('--')}" if word.startswith("--") else word for word in choice]
        return " ".join(words) or f"no {name} options"
    return f"{name} {choice or 'nothing'}"
