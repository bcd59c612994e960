"""`ssa report`: results folders in, one report as HTML and Markdown out."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from itertools import product
from pathlib import Path

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.data.writing import staged_file, unwritable_as_input_error, write_text
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.report import (
    category_tables,
    detail_tables,
    difference_tables,
    real_tables,
)
from ssa_nerfstudio.experiments.benchmark.report.document import Document, Picture, Section, Table
from ssa_nerfstudio.experiments.benchmark.report.latex import write_latex
from ssa_nerfstudio.experiments.benchmark.report.picture_sheets import sheet
from ssa_nerfstudio.experiments.benchmark.report.study import Study, studies
from ssa_nerfstudio.experiments.benchmark.results import Result, absence, read_named
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Benchmark
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run

PLANS = "plans"
"""Folder beside the results: what was asked for."""


def store_plan(folder: Path, command: str, benchmark: Benchmark, runs: list[Run]) -> None:
    """Notes beside the results which runs were planned, so that a report can say what is missing."""
    path = folder / PLANS / f"{command}-{benchmark.name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    values = {"benchmark": benchmark.name, "protocol": benchmark.protocol, "runs": [run.id for run in runs]}
    write_text(path, json.dumps(values, indent=1) + "\n")


def report(folders: list[Path], output: Path) -> tuple[list[Path], list[str]]:
    """Writes report.md and report.html, with sheets beside them, and the tables as report.tex.

    Args:
        folders: of `ssa bench`; of a run that several hold, one is taken.
        output: folder of the report.

    Returns:
        The files, and a line for every file that was ignored.

    Raises:
        InputError: there is no result at all.
    """
    results, problems = read_named(folders)
    if not any(result.status != "failed" and not result.run.marks for result in results):
        raise InputError(f"{folders[0]}/results holds no result of ssa bench that ended", "run ssa bench first")
    planned, protocols = _plans(folders)
    sections = [_overview(results, planned, problems, folders)]
    for study in studies(results):
        sections.append(_section(study, protocols == {"paper"} and study.steps == 30_000))
        pictures = _sheets(study, folders, output)
        if pictures:
            sections.append(Section(f"Pictures, {study.title}", contents=list(pictures)))
    document = Document("What the overlay restores", sections)
    return [*document.write(output, "report"), write_latex(document, output / "report.tex")], problems


def _plans(folders: list[Path]) -> tuple[set[str], set[str]]:
    runs: set[str] = set()
    protocols: set[str] = set()
    for folder in folders:
        for path in sorted((folder / PLANS).glob("bench-*.json")):
            try:
                values = json.loads(read_text(path))
                runs |= set(values["runs"])
                protocols.add(values["protocol"])
            except (OSError, ValueError, KeyError, TypeError):
                continue  # only what is missing is then not known
    return runs, protocols


def _overview(results: list[Result], planned: set[str], problems: list[str], folders: list[Path]) -> Section:
    results = [result for result in results if not result.run.marks]
    counts = Counter(result.status for result in results)
    text = [
        f"Made by `ssa report {' '.join(shlex.quote(str(folder)) for folder in folders)}` from "
        f"{counted(len(results), 'run')}: {counts['finished']} finished, {counts['diverged']} diverged (†, left out of "
        f"means), {counts['failed']} failed; {absence(results, planned)}. Every run's JSON holds its command.",
        "PSNR, SSIM (valid padding), FLIP and mean color deviation (0 to 255) compare the clean render with "
        "clean test views that no training saw.",
    ]
    made = Counter(
        (r.versions.get("device", "?"), r.versions.get("torch", "?"), r.versions.get("gsplat", "?"), r.revision)
        for r in results
    )
    rows = [[*key, str(count)] for key, count in made.most_common()]
    contents: list[Table | Picture] = [Table("Made on", ["device", "torch", "gsplat", "revision", "runs"], rows)]
    if len({key[3] for key in made}) > 1:
        text.append("**Runs of several revisions of the code are mixed here.**")
    shared = sum(bool(r.same_as) for r in results)
    if shared:
        text.append(f"{shared} of them are the trainings of others under another method's name, and were not repeated.")
    troubles = [[r.run.id, r.status, r.reason] for r in results if r.status != "finished"]
    if troubles:
        contents.append(Table("Runs that did not finish", ["run", "", "why"], troubles))
    if problems:
        contents.append(Table("Files that were ignored", ["file and reason"], [[line] for line in problems]))
    return Section("What this is made of", text, contents)


def _section(study: Study, with_paper: bool) -> Section:
    if not study.clean_tests:
        drawn = [detail_tables.by_mask(study), detail_tables.cost(study)]
        return Section(study.title, [], [table for table in drawn if table is not None])
    if study.real:
        results = [real_tables.real_by_method(study, with_paper), real_tables.real_by_scene(study, with_paper)]
    else:
        results = [category_tables.results_by_category(study, with_paper)]
    drawn = [
        *results,
        detail_tables.results_by_scene(study),
        category_tables.sensitivity(study, with_paper),
        category_tables.ablation(study, with_paper),
        difference_tables.paired(study, "default"),
        difference_tables.paired(study, "overlay-on") if "default" not in study.methods else None,
        detail_tables.artifact_itself(study),
        detail_tables.by_mask(study),
        detail_tables.by_exposure(study),
        detail_tables.cost(study),
    ]
    seeds = sorted({result.run.seed for result in study.results})
    text = [f"Schedules scaled by {study.steps} / 30000; seeds {', '.join(map(str, seeds))}."]
    if len(seeds) < 2:
        text.append("One seed: differences below about 0.3 dB are noise until they have been repeated.")
    if with_paper:
        text.append("The paper's protocol: its metrics are below ours. gsplat's own clean ADC reference is 28.95.")
    return Section(study.title, text, [table for table in drawn if table is not None])


def _sheets(study: Study, folders: list[Path], output: Path) -> list[Picture]:
    """A sheet for every scene and artifact: the first seed of every method, ADC where it was run."""
    pictures = []
    for (effect, scene), densification in product(study.subjects, study.densifications):
        cells = (study.select(effect, scene, method, densification) for method in study.methods)
        firsts = [finished[0] for cell in cells if (finished := [r for r in cell if r.status == "finished"])]
        drawn = sheet([(result, _pictures(result, folders)) for result in firsts])
        if drawn is not None:
            path = output / "sheets" / f"{scene}-{effect}-{densification}-{study.steps}-e{study.effect_seed}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            with unwritable_as_input_error(path), staged_file(path) as part:
                drawn.save(part, format="JPEG", quality=88)
            pictures.append(Picture(path, f"{scene}, {effect}, {densification.upper()}, {study.title}"))
    return pictures


def _pictures(result: Result, folders: list[Path]) -> Path:
    found = [folder / "pictures" / result.run.id for folder in folders]
    return next((path for path in found if path.is_dir()), found[0])
