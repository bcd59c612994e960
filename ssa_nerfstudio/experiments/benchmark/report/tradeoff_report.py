"""`ssa tradeoff`: what accuracy costs in time, from the curves of runs that had their device to themselves."""

from __future__ import annotations

import csv
import shlex
from pathlib import Path

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.data.writing import staged_file, unwritable_as_input_error
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.report.document import Document, Picture, Section, Table
from ssa_nerfstudio.experiments.benchmark.report.frontier import Point, knee, price
from ssa_nerfstudio.experiments.benchmark.report.tradeoff_curves import Curve, Subject
from ssa_nerfstudio.experiments.benchmark.report.tradeoff_figure import draw
from ssa_nerfstudio.experiments.benchmark.results import Result, absence, read_all

MEASURED = ("step", "seconds", "psnr", "ssim", "flip", "gaussians")
"""What a run notes at every mark."""
COLUMNS = ("scene", "effect", "setting", *MEASURED, "on_frontier", "knee", "alone", "device", "run", "command")
"""Of the CSV: a line for every point."""


def analyze(folders: list[Path], output: Path, planned: set[str]) -> tuple[list[Path], list[str]]:
    """Writes tradeoff.md and .html, tradeoff.csv, and a figure for every subject as PNG and SVG.

    Args:
        folders: of `ssa tradeoff`.
        output: folder of the report.
        planned: ids of the runs that it should be made from, so that it can name those that are missing.

    Returns:
        The files, and lines about what was left out: files that are no results, runs that did not finish, and, from
        frontiers only, runs that shared their device.

    Raises:
        InputError: no run finished.
    """
    results, problems = read_all(folders)
    along = [result for result in results if result.status == "finished" and result.curve]
    problems += [f"{r.run.id} {r.status}: {r.reason}" for r in results if r.run.marks and r.status != "finished"]
    if not along:
        raise InputError(f"{folders[0]} holds no finished run of ssa tradeoff", "run ssa tradeoff NAME first")
    shared = [result for result in along if not result.alone]
    problems += [f"{result.run.id} shared its device: drawn, but on no frontier" for result in shared]
    output.mkdir(parents=True, exist_ok=True)
    chosen = _subjects(along)
    sections, files = [], [_write_csv(chosen, output / "tradeoff.csv")]
    for subject in chosen:
        pictures = draw(subject, output)
        files += pictures
        sections.append(_section(subject, pictures[0]))
    source = " --merge ".join(shlex.quote(str(folder)) for folder in folders)
    about = Section(
        "How to read this",
        [
            f"Made by `ssa tradeoff NAME --report-only --output {source}` from "
            f"{counted(len(along), 'run')}, {len(shared)} of which shared their device: those are drawn, "
            f"but on no frontier; {absence(results, planned)}. Seconds are the overlay's statistics and training; "
            "decoding photos and evaluations along the way are not counted. Quality is that of the clean "
            "render on clean test views at full resolution.",
            "A point on the frontier is beaten by no other in both time and PSNR. The knee is the point farthest above "
            "the line between the frontier's ends, over the logarithm of seconds. Learning rates fall over the whole "
            "length of a run: a point early in a long run is worse than the end of a short one.",
        ],
    )
    if problems:
        about.contents.append(Table("Left out", ["what and why"], [[line] for line in problems]))
    files += Document("What accuracy costs in time", [about, *sections]).write(output, "tradeoff")
    return files, problems


def _subjects(results: list[Result]) -> list[Subject]:
    keys: dict[tuple[str, str, str], list[Curve]] = {}
    for result in results:
        key = (result.run.scene, result.run.effect, result.versions.get("device", "?"))
        keys.setdefault(key, []).append(Curve(result))
    return [Subject(*key, sorted(curves, key=_order)) for key, curves in sorted(keys.items())]


def _order(curve: Curve) -> tuple:
    """Few knobs before many, numbers by size."""
    run = curve.result.run
    values = [(0, v, "") if isinstance(v, (int, float)) else (1, 0, str(v)) for v in run.variation.values()]
    return len(curve.knobs), curve.knobs, values, run.seed


def _section(subject: Subject, figure: Path) -> Section:
    front = subject.front()
    bend = knee(front)
    text = [f"On {subject.device}. {subject.around}".rstrip()]
    if not subject.alone:
        text.append("**Every run shared its device: seconds mean little, and there is no frontier.**")
    if bend is not None:
        curve, point = subject.whose(bend)
        reached = f"**The knee: {bend.quality:.2f} dB after {bend.seconds:.1f} s**"
        text.append(f"{reached} ({curve.setting}, step {point['step']:.0f}).")
    caption = f"{subject.scene} behind {subject.effect}, {subject.device}"
    contents: list[Table | Picture] = [Picture(figure, caption)]
    rows = []
    for step in price(front):
        curve, _ = subject.whose(next(p for p in front if p.seconds == step.seconds))
        factor = step.seconds / (step.seconds - step.more) if step.more < step.seconds else float("inf")
        times = f"{step.start:.2f} to {step.end:.2f}"
        rows.append([times, f"{step.more:.1f}", f"x {factor:.2f}", f"{step.seconds:.1f}", curve.setting])
    note = "Along the frontier, counted back from its best point."
    if rows:
        contents.append(Table("What 1 dB costs", ["dB", "more s", "", "s in all", "reached by"], rows, note))
    contents.append(_knob_table(subject))
    if front:
        contents.append(_frontier_table(subject, front, bend))
    return Section(f"{subject.scene}, {subject.effect}", text, contents)


def _knob_table(subject: Subject) -> Table:
    """The end of every run against the base's end."""
    base = subject.base
    reference = base.points[-1] if base is not None and base.points else None
    rows = []
    for curve in subject.curves:
        if not curve.points:
            continue
        end = curve.points[-1]
        seconds = f"{end['seconds']:.1f}{'' if curve.result.alone else ' (shared)'}"
        cells = [f"{end['psnr']:.2f}", f"{end['ssim']:.3f}", f"{end['flip']:.3f}", seconds]
        difference = ["", "", ""]
        if reference is not None and curve is not base:
            gain, more = end["psnr"] - reference["psnr"], end["seconds"] - reference["seconds"]
            # A price exists only where one buys the other: more seconds for more decibels, or fewer for fewer.
            rate = f"{more / gain:.1f}" if abs(gain) > 0.05 and gain * more > 0 else "-"
            comparable = curve.result.alone and base is not None and base.result.alone
            difference = [f"{gain:+.2f}", *([f"{more:+.1f}", rate] if comparable else ["", ""])]
        rows.append([curve.setting, *cells, f"{end['gaussians']:,.0f}", *difference])
    compared = ["dB vs base", "s vs base", "s for 1 dB"]
    headings = ["Setting", "PSNR ↑", "SSIM ↑", "FLIP ↓", "seconds", "Gaussians", *compared]
    note = (
        "At the end of each run. s for 1 dB: what is paid, or saved, for each; - where one setting is better in both."
    )
    return Table("Knob by knob", headings, rows, note)


def _frontier_table(subject: Subject, front: list[Point], bend: Point | None) -> Table:
    rows = []
    for point in front:
        curve, entry = subject.whose(point)
        mark = "knee" if point == bend else ""
        cells = [f"{point.seconds:.1f}", f"{point.quality:.2f}", curve.setting, f"{entry['step']:.0f}", mark]
        rows.append([*cells, f"`{curve.result.command}`"])
    return Table("The frontier", ["seconds", "PSNR", "setting", "step", "", "command"], rows)


def _write_csv(subjects: list[Subject], path: Path) -> Path:
    with (
        unwritable_as_input_error(path),
        staged_file(path) as part,
        part.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for subject in subjects:
            front = subject.front()
            bend = knee(front)
            for curve in subject.curves:
                result = curve.result
                for entry in curve.points:
                    point = Point(entry["seconds"], entry["psnr"]) if result.alone else None
                    marks = int(point in front), int(point is not None and point == bend), int(result.alone)
                    origin = subject.device, result.run.id, result.command
                    measured = (entry[name] for name in MEASURED)
                    writer.writerow((subject.scene, subject.effect, curve.setting, *measured, *marks, *origin))
    return path
