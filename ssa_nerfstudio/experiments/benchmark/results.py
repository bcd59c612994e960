"""One JSON a run: written at once, checked when read; a file that is no result is named and left aside."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.data.writing import staged_file
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run
from ssa_nerfstudio.experiments.configuration import build

FORMAT = "ssa-nerfstudio benchmark run"
"""Marks a file as one of ours."""
VERSION = 2
"""Version 1 spelled the key `mean_color_deviation` another way; it is read, too."""
MEASURED = ("psnr", "ssim", "flip")
"""Metrics of every finished run."""
STAGES = ("startup", "statistics", "training", "evaluation")
"""Parts of a run whose seconds are counted."""
Status = Literal["finished", "diverged", "failed"]
Number = float | None
"""None: infinity, which JSON lacks."""


@dataclass
class Result:
    """What one run gave: the JSON's contents."""

    run: Run
    status: Status
    """finished; diverged: nothing to evaluate was left; failed: it ended in an error and will be tried again."""
    reason: str = ""
    """Of a run that did not finish."""
    metrics: dict[str, Number] = field(default_factory=dict)
    """Means over the test views: psnr (dB), ssim ("valid" padding), flip, mean_color_deviation (0..255), ..."""
    views: dict[str, dict[str, Number]] = field(default_factory=dict)
    """The same of each test view by its file's name."""
    artifact: dict[str, float] = field(default_factory=dict)
    """The learned overlay against the true layers (`metrics.matte.layer_errors`), mean over cameras; where a mask is
    stated in their place, mean mattes inside and outside (`ArtifactRegion.mattes`)."""
    curve: list[dict[str, int | Number]] = field(default_factory=list)
    """Metrics along the run: step, seconds, gaussians, metrics."""
    seconds: dict[str, float] = field(default_factory=dict)
    """startup, statistics, training, evaluation; startup counts from when the run was asked for."""
    alone: bool = False
    """Whether the run had its device to itself."""
    company: dict[str, float] = field(default_factory=dict)
    """runs_per_device, and the share of all cores that other processes used meanwhile."""
    gaussians: int = 0
    peak_memory_mb: float = 0.0
    """Largest memory that torch held on the GPU while training; on a CPU that of the process."""
    schedules: dict[str, Any] = field(default_factory=dict)
    """The schedules as they were scaled, in steps."""
    versions: dict[str, str] = field(default_factory=dict)
    """Packages, Python and the device."""
    revision: str = ""
    """git revision of the code; + where files differed from it."""
    command: str = ""
    """What repeats this run, or the one that it is the same as."""
    same_as: str = ""
    """Id of the run that was trained, where this one is the same training under another method's name."""
    ended: str = ""
    """When, UTC, ISO 8601."""

    @property
    def total_seconds(self) -> float:
        """From when the run was asked for to its end."""
        return sum(self.seconds.values())

    @property
    def learning_seconds(self) -> float:
        """Of the photos' statistics and the training, which settings decide; of a finished run."""
        return self.seconds["statistics"] + self.seconds["training"]


def write(result: Result, path: Path) -> None:
    """Writes a result; the file appears when it is complete."""
    values = {"format": FORMAT, "version": VERSION, **dataclasses.asdict(result)}
    # JSON has no infinity: the PSNR of equal pictures becomes null.
    finite = json.loads(json.dumps(values), parse_constant=lambda name: None)
    path.parent.mkdir(parents=True, exist_ok=True)
    with staged_file(path) as part:
        part.write_text(json.dumps(finite, indent=1) + "\n", encoding="utf-8")


def read(path: Path) -> Result:
    """One result.

    Raises:
        InputError: the file cannot be read, is truncated, or is something else.
    """
    if not path.is_file():
        raise InputError(f"{path} is no file")
    try:
        values = json.loads(read_text(path), object_pairs_hook=_current_names)
    except (OSError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} cannot be read ({error})") from error
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path} is no whole JSON ({error}): truncated?") from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise InputError(f"{path} is not a result of ssa bench")
    if values.get("version") not in (1, VERSION):
        raise InputError(f"{path} is of version {values.get('version')!r}, this reads version {VERSION}")
    known = {field.name for field in dataclasses.fields(Result)}
    result = build(Result, {name: value for name, value in values.items() if name in known}, str(path))
    if result.status == "finished":
        for held, needed in ((result.metrics, MEASURED), (result.seconds, STAGES)):
            if missing := [name for name in needed if name not in held]:
                raise InputError(f"{path} is a finished run without {', '.join(missing)}")
    if result.run.id != path.stem:
        raise InputError(f"{path} holds the run {result.run.id}: renamed, or edited")
    return result


def read_all(folders: list[Path]) -> tuple[list[Result], list[str]]:
    """The results of several folders of `ssa bench`, each run once: the first that finished, else the last seen.

    Returns:
        Results in the order of their files, and a line for every file that is none.
    """
    found: dict[str, Result] = {}
    problems = []
    for folder in folders:
        for path in sorted((folder / "results").glob("*.json")):
            try:
                result = read(path)
            except InputError as problem:
                problems.append(str(problem))
                continue
            if result.run.id not in found or found[result.run.id].status == "failed":
                found[result.run.id] = result
    return list(found.values()), problems


def read_named(folders: Sequence[Path]) -> tuple[list[Result], list[str]]:
    """`read_all` of folders that a user names.

    Raises:
        InputError: none is named, or one does not exist or is none of `ssa bench`.
    """
    if not folders:
        raise InputError("no folder of results is named", "name the --output folder of ssa bench")
    for folder in folders:
        if not (folder / "results").is_dir():
            missing = "" if folder.exists() else ": it does not exist"
            raise InputError(f"{folder} holds no results{missing}", "choose the output folder of ssa bench")
    return read_all([*folders])


def absence(results: list[Result], planned: set[str]) -> str:
    """A clause for a report: how many of the planned runs have no result, and which.

    Args:
        results: what there is.
        planned: ids; empty where that is not known.
    """
    if not planned:
        return "what was planned is not noted beside the results, so that missing ones are not known"
    missing = planned - {result.run.id for result in results}
    named = f": {', '.join(f'`{run}`' for run in sorted(missing))}" if missing else ""
    return f"missing are {len(missing)} of {len(planned)} that were planned{named}"


def merge(source: Path, target: Path) -> int:
    """Copies the results that another folder has and this one has not, with their pictures and logs.

    Returns:
        How many were copied.
    """
    present = {result.run.id: result for result in read_all([target])[0]}
    copied = 0
    for result in read_all([source])[0]:
        run = result.run.id
        if run in present and (present[run].status != "failed" or result.status == "failed"):
            continue
        _copy_companions(source, run, target, run)
        write(result, target / "results" / f"{run}.json")
        copied += 1
    return copied


def adopt(result: Result, run: Run, folder: Path) -> Result:
    """Writes a result, with pictures and log, for another run of the same training.

    Returns:
        What was written.
    """
    _copy_companions(folder, result.run.id, folder, run.id)
    adopted = dataclasses.replace(result, run=run, same_as=result.same_as or result.run.id)
    write(adopted, folder / "results" / f"{run.id}.json")
    return adopted


def _copy_companions(source: Path, run: str, target: Path, name: str) -> None:
    """Pictures and log of a run to another folder, or under another name."""
    for kind, suffix in (("pictures", ""), ("logs", ".log")):
        origin, goal = source / kind / f"{run}{suffix}", target / kind / f"{name}{suffix}"
        if origin.is_dir():
            shutil.copytree(origin, goal, dirs_exist_ok=True)
        elif origin.exists():
            goal.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(origin, goal)


def _current_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON with the keys of version 1 as they are spelled now."""
    return {"mean_color_deviation" if key == "mean_colour_deviation" else key: value for key, value in pairs}
