"""A row for each capture and artifact: off, paper's rule, default and oracle: `python benchmarks/rows.py RESULTS`

From results of `ssa bench captures`; PSNR in dB, means over seeds. With --methods, a column for each of them, the rows
that at least one of them has, and the mean over those that all of them have; below it, what each costs on those:
`python benchmarks/rows.py RESULTS --methods 3dgs desplat default default/mcmc`.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.report.study import MAX_LOSS, Study, lead, mean, studies
from ssa_nerfstudio.experiments.benchmark.results import Result, read_named


def cells(study: Study, effect: str, scene: str, densification: str) -> list[str]:
    """off, paper's rule, default (worst view), oracle."""
    off, paper, ours, oracle, worst = (
        mean(study.select(effect, scene, method, densification), metric)
        for method, metric in (
            ("3dgs", "psnr"),
            ("paper", "psnr"),
            ("default", "psnr"),
            ("given", "psnr"),
            ("default", "psnr worst"),
        )
    )
    shown = ["" if value is None else f"{value:.2f}" for value in (off, paper, ours, oracle)]
    if worst is not None:
        shown[2] += f" ({worst:.1f})"
    return shown


def marked(difference: float | None) -> str:
    """A difference as a cell, bold where the default is further behind than it may be."""
    if difference is None:
        return ""
    return f"{difference:+.2f}" if difference >= -MAX_LOSS else f"**{difference:+.2f}**"


def columns_of(methods: Sequence[str], compared: Sequence[Study]) -> list[tuple[str, str]]:
    """Method and densification of each column.

    Raises:
        InputError: there are no results of one of them.
    """
    columns = [(name, densification or "adc") for name, _, densification in (m.partition("/") for m in methods)]
    there = {(r.run.method, r.run.densification): None for study in compared for r in study.results}
    known = [name if densification == "adc" else f"{name}/{densification}" for name, densification in sorted(there)]
    for method, column in zip(methods, columns, strict=True):
        if column not in there:
            raise InputError(f"--methods: there are no results of {method!r}", f"choose among {', '.join(known)}")
    return columns


def side_by_side(study: Study, methods: Sequence[str], columns: Sequence[tuple[str, str]]) -> str:
    """A table of PSNR, a column for each method (`default`, or `default/mcmc`); empty where the study has none of them.

    Rows are what at least one of them has, the mean is over those that all of them have.
    """
    lines = [f"| | | {' | '.join(methods)} |", f"|{'---|' * (2 + len(methods))}"]
    full: list[list[float]] = []
    for effect, scene in sorted(study.pairs, key=lambda pair: pair[1]):
        row = [mean(study.select(effect, scene, *column), "psnr") for column in columns]
        if any(value is not None for value in row):
            lines.append(f"| `{scene}` | {effect} | {' | '.join('' if v is None else f'{v:.2f}' for v in row)} |")
        if None not in row:
            full.append([value for value in row if value is not None])
    if full:
        means = (statistics.mean(column) for column in zip(*full, strict=True))
        lines.append(f"| mean of {len(full)} | | {' | '.join(f'{value:.2f}' for value in means)} |")
    return "\n".join(lines) if len(lines) > 2 else ""


def costs(study: Study, methods: Sequence[str], columns: Sequence[tuple[str, str]]) -> str:
    """A row for each method, means over the rows that all of them have; empty where there are none.

    FLIP, mean color deviation, peak memory, and seconds of statistics and training in units of the first method's.
    """
    cells = [[study.select(*pair, *column) for column in columns] for pair in study.pairs]
    whole = [row for row in cells if all(mean(chosen, "psnr") is not None for chosen in row)]
    if not whole:
        return ""

    def mean_of(figure: Callable[[Result], float], column: int) -> float:
        finished = ([r for r in row[column] if r.status == "finished"] for row in whole)
        return statistics.mean(statistics.mean(map(figure, chosen)) for chosen in finished)

    seconds = [mean_of(lambda r: r.learning_seconds, k) for k in range(len(columns))]
    heads = ("FLIP", "color deviation", "peak MB", f"seconds, {methods[0]} = 1")
    lines = [f"| mean of {len(whole)} | {' | '.join(heads)} |", f"|{'---|' * (1 + len(heads))}"]
    for k, method in enumerate(methods):
        flip, deviation = (mean_of(lambda r, m=m: r.metrics[m], k) for m in ("flip", "mean_color_deviation"))
        memory = mean_of(lambda r: r.peak_memory_mb, k)
        lines.append(f"| {method} | {flip:.3f} | {deviation:.1f} | {memory:.0f} | {seconds[k] / seconds[0]:.2f} |")
    return "\n".join(lines)


@dataclass
class Command:
    """Print a table for each length: a row for each capture and artifact."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDERS")] = ()
    """Output folders of `ssa bench`; several are added up."""

    methods: tuple[str, ...] = ()
    """Columns: methods under ADC, or METHOD/mcmc; rows are those that at least one has, the mean is over those that all
    have, as is the table of costs below it. Empty: off, paper's rule, default and oracle under both."""

    def run(self) -> None:
        """Print.

        Raises:
            InputError: there are no results, or none of a method.
        """
        results, _ = read_named(self.folders)
        compared = [study for study in studies(results) if study.clean_tests]
        if not compared:
            raise InputError("no results with clean test photos", "name the --output of ssa bench captures")
        chosen = columns_of(self.methods, compared)
        for study in compared:
            if chosen:
                if table := side_by_side(study, self.methods, chosen):
                    print(f"\n{study.title}\n\n{table}")
                    if table := costs(study, self.methods, chosen):
                        print(f"\n{table}")
                continue
            columns = ("off", "paper's rule", "default (worst view)", "oracle", "difference")
            heads = [f"{d.upper()}: {column}" for d in study.densifications for column in columns]
            print(f"\n{study.title}\n\n| | | {' | '.join(heads)} |\n|{'---|' * (2 + len(heads))}")
            differences: list[list[float]] = [[] for _ in study.densifications]
            for effect, scene in sorted(study.pairs, key=lambda pair: pair[1]):
                row: list[str] = []
                for found, densification in zip(differences, study.densifications, strict=True):
                    difference = lead(study, effect, scene, densification)
                    row += [*cells(study, effect, scene, densification), marked(difference)]
                    found += [] if difference is None else [difference]
                print(f"| `{scene}` | {effect} | {' | '.join(row)} |")
            for densification, found in zip(study.densifications, differences, strict=True):
                if found:
                    middle, smallest = statistics.median(found), min(found)
                    held = sum(value >= -MAX_LOSS for value in found)
                    print(
                        f"\n{densification.upper()}: mean {statistics.mean(found):+.2f}, median {middle:+.2f}, worst "
                        f"{smallest:+.2f} dB; {held} of {len(found)} are at most {MAX_LOSS} dB behind."
                    )


if __name__ == "__main__":
    run_script(Command)
