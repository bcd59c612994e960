"""Differences between methods: paired by test view, and the acceptance thresholds of the default."""

from __future__ import annotations

import statistics
from itertools import product

from ssa_nerfstudio.experiments.benchmark.report.bootstrap import bootstrap, paired_differences
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import METRICS, Study, belongs, finite, mean
from ssa_nerfstudio.experiments.benchmark.report.table_cells import FORMATS, HEADINGS, row_name
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, title

MAIN_METHODS = ("3dgs", "default", "overlay-on", "paper", "given")


def paired(study: Study, ours: str) -> Table | None:
    """Differences of one method to the others, paired view by view, with bootstrap intervals; None without pairs."""
    others = [name for name in MAIN_METHODS if name != ours and name in study.methods]
    rows = []
    for other, densification, kind in product(others, study.densifications, [*study.kinds, CLEAN]):
        groups = [_difference_groups(study, kind, ours, other, densification, metric) for metric in METRICS]
        cells = [_interval(group, metric) for group, metric in zip(groups, METRICS, strict=True)]
        if any(cells):
            name = "Clean photos" if kind == CLEAN else row_name(kind)
            rows.append([f"minus {title(other)}", densification.upper(), name, *cells])
    if not rows:
        return None
    note = (
        "Paired by test view and seed; mean over scenes, with 95 % bootstrap intervals over test views: what other "
        "views of the same scenes would change, not what other scenes would."
    )
    headings = ["", "", "Artifact", *(HEADINGS[metric][:-2] for metric in METRICS)]
    return Table(f"{title(ours)}: paired differences", headings, rows, note)


def acceptance(study: Study) -> Table | None:
    """Acceptance thresholds of the default method; None where it was not run."""
    rows = [row for densification in study.densifications for row in _thresholds(study, densification)]
    headings = ["", "Requirement", "difference, dB", "met"]
    return Table("Acceptance thresholds of the default", headings, rows) if rows else None


def _thresholds(study: Study, densification: str) -> list[list[str]]:
    rows, differences = [], []

    def psnr(effect: str, scene: str, method: str) -> float | None:
        return mean(study.select(effect, scene, method, densification), "psnr")

    def require(what: str, value: float, reference: float, margin: float) -> None:
        met = "yes" if value >= reference - margin else "**no**"
        rows.append([densification.upper(), what, f"{value - reference:+.2f}", met])

    for effect, scene in study.pairs:
        ours, rule, given = (psnr(effect, scene, method) for method in ("default", "paper", "given"))
        references = finite((rule, given))
        if ours is not None and references:
            require(f"{scene}, {effect}: better of paper's rule and oracle, minus 0.2", ours, max(references), 0.2)
            differences += [ours - given] if given is not None else []
    if differences:
        require("mean over all: not below the oracle", statistics.mean(differences), 0.0, 0.0)
    for scene in study.scenes:
        on, off = psnr(CLEAN, scene, "overlay-on"), psnr(CLEAN, scene, "3dgs")
        if on is not None and off is not None:
            require(f"{scene}, clean: overlay on within 0.1 of off", on, off, 0.1)
    return rows


def _difference_groups(
    study: Study, kind: str, ours: str, other: str, densification: str, metric: str
) -> list[list[float]]:
    """Per-view differences for every scene and effect of a category, seeds pooled."""
    groups = []
    for effect, scene in sorted(study.subjects):
        if not belongs(effect, kind):
            continue
        by_seed = {r.run.seed: r for r in study.select(effect, scene, other, densification)}
        group: list[float] = []
        for mine in study.select(effect, scene, ours, densification):
            theirs = by_seed.get(mine.run.seed)
            if theirs is not None and mine.status == theirs.status == "finished":
                group += paired_differences(mine.views, theirs.views, metric)
        if group:
            groups.append(group)
    return groups


def _interval(groups: list[list[float]], metric: str) -> str:
    if not groups:
        return ""
    form = FORMATS[metric].replace(":", ":+")
    interval = bootstrap(groups)
    return f"{form.format(interval.mean)} [{form.format(interval.low)}, {form.format(interval.high)}]"
