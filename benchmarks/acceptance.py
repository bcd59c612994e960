"""Thresholds that the default method has to meet: `python benchmarks/acceptance.py RESULTS`

From results of `ssa bench captures`. Means over seeds; exit code 1 where one is missed.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.report.study import MAX_LOSS, Study, finite, lead, mean, studies
from ssa_nerfstudio.experiments.benchmark.results import Result, read_named
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN


@dataclass(frozen=True)
class Threshold:
    """A requirement and what was measured."""

    what: str
    value: float
    at_least: float

    def __str__(self) -> str:
        """A line of the table."""
        met = "yes" if self.met else "**no**"
        return f"| {self.what} | {self.value:+.2f} | {self.at_least:+.2f} | {met} |"

    @property
    def met(self) -> bool:
        """Whether it is."""
        return self.value >= self.at_least


def thresholds(study: Study, densification: str) -> Iterator[Threshold]:
    """What one study says about the default, in dB unless it says matte; nothing about what was not run.

    Args:
        study: runs of equal length.
        densification: adc or mcmc.
    """

    def of(effect: str, scene: str, method: str, metric: str = "psnr") -> float | None:
        return mean(study.select(effect, scene, method, densification), metric)

    if not study.clean_tests:
        for effect, scene in study.pairs:
            where = f"{scene}, {effect}"
            ours, off = (of(effect, scene, method, "outside_psnr") for method in ("default", "3dgs"))
            if ours is not None and off is not None:
                yield Threshold(f"{where}: outside the mask, default - off", ours - off, 0.3)
            mattes = [r.artifact for r in study.select(effect, scene, "default", densification) if r.artifact]
            if mattes:
                inside, sky = (statistics.mean(m[f"matte_{at}"] for m in mattes) for at in ("inside", "upper_third"))
                yield Threshold(f"{where}: mean matte inside", inside, 0.8)
                yield Threshold(f"{where}: - mean matte of the upper third", -sky, -0.02)
        return
    differences, gaps, deviations = [], [], []
    for effect, scene in study.pairs:
        where = f"{scene}, {effect}"
        runs = study.select(effect, scene, "default", densification)
        ours, clean = of(effect, scene, "default"), of(CLEAN, scene, "3dgs")
        if (difference := lead(study, effect, scene, densification)) is not None:
            differences.append(difference)
            yield Threshold(f"{where}: default - better of paper's rule and oracle", difference, -MAX_LOSS)
        if ours is not None and clean is not None and runs[0].run.real:
            yield Threshold(f"{where}: default - the same photos without it", ours - clean, -1.0)
        gaps += [gap for run in runs if (gap := worst_gap(run)) is not None]
        deviations += finite([of(effect, scene, "default", "mean_color_deviation")])
    if differences:
        yield Threshold("mean of default - better of paper's rule and oracle", statistics.mean(differences), 0.0)
    if gaps:
        yield Threshold("worst test view - second worst, smallest of a run", min(gaps), -6.0)
    if deviations:
        yield Threshold("- mean color deviation, 0 to 255", -statistics.mean(deviations), -1.6)
    for scene in study.scenes:
        on, off = of(CLEAN, scene, "overlay-on"), of(CLEAN, scene, "3dgs")
        if on is not None and off is not None:
            yield Threshold(f"{scene}, clean: overlay on - off", on - off, -0.1)


def worst_gap(result: Result) -> float | None:
    """PSNR of the worst minus that of the second worst test view, dB; None for fewer than two."""
    ordered = sorted(finite(view.get("psnr") for view in result.views.values()))
    return ordered[0] - ordered[1] if len(ordered) > 1 else None


@dataclass
class Command:
    """Print which acceptance thresholds the default method meets."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDERS")] = ()
    """Output folders of `ssa bench`; several are added up."""

    def run(self) -> None:
        """Print a table for each length and densification.

        Raises:
            InputError: there are no results to judge.
        """
        results, _ = read_named(self.folders)
        missed = judged = 0
        for study in studies(results):
            for densification in study.densifications:
                found = [*thresholds(study, densification)]
                judged, missed = judged + len(found), missed + sum(not each.met for each in found)
                if found:
                    heading = f"{study.title}, {densification.upper()}"
                    print(f"\n| {heading} | measured | at least | met |\n|---|---|---|---|", *found, sep="\n")
        if not judged:
            raise InputError("no results of the default and its references", "name the --output of ssa bench captures")
        print(f"\n{judged - missed} of {judged} are met.")
        sys.exit(1 if missed else 0)


if __name__ == "__main__":
    run_script(Command)
