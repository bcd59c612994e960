"""Differences between methods: paired by test view, and the acceptance thresholds of the default."""

from __future__ import annotations

import statistics as plain

from ssa_nerfstudio.experiments.benchmark.report.bootstrap import bootstrap, paired_differences
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import MEAN, METRICS, Study, finite
from ssa_nerfstudio.experiments.benchmark.report.table_cells import (
    FORMATS,
    HEADINGS,
    ROW_NAMES,
)
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, category, title

MAIN_METHODS = ("3dgs", "default", "overlay-on", "paper", "given")


def paired(study: Study, ours: str) -> Table | None:
    """Differences of one method to the others, paired view by view, with bootstrap intervals; None without pairs."""
    rows = []
    for other in [name for name in MAIN_METHODS if name != ours and name in study.methods]:
        for densification in study.densifications:
            for kind in [*study.categories, *([MEAN] if len(study.categories) > 1 else []), CLEAN]:
                cells = []
                for metric in METRICS:
                    groups = _difference_groups(study, kind, ours, other, densification, metric)
                    cells.append(_interval(groups, metric))
                if any(cells):
                    name = ROW_NAMES.get(kind, kind.capitalize()) if kind != CLEAN else "Clean photos"
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
    rows = []
    for densification in study.densifications:

        def psnr(effect: str, scene: str, method: str, densification: str = densification) -> float | None:
            chosen = study.select(effect, scene, method, densification)
            values = finite(r.metrics.get("psnr") for r in chosen if r.status == "finished")
            return plain.mean(values) if values else None

        differences = []
        for effect, scene in study.pairs:
            ours, rule, given = (psnr(effect, scene, method) for method in ("default", "paper", "given"))
            if ours is None or (rule is None and given is None):
                continue
            best = max(value for value in (rule, given) if value is not None)
            met = "yes" if ours >= best - 0.2 else "**no**"
            what = f"{scene}, {effect}: better of paper's rule and oracle, minus 0.2"
            rows.append([densification.upper(), what, f"{ours - best:+.2f}", met])
            if given is not None:
                differences.append(ours - given)
        if differences:
            mean = plain.mean(differences)
            met = "yes" if mean >= 0 else "**no**"
            rows.append([densification.upper(), "mean over all: not below the oracle", f"{mean:+.2f}", met])
        for scene in study.scenes:
            on, off = psnr(CLEAN, scene, "overlay-on"), psnr(CLEAN, scene, "3dgs")
            if on is not None and off is not None:
                met = "yes" if on >= off - 0.1 else "**no**"
                what = f"{scene}, clean: overlay on within 0.1 of off"
                rows.append([densification.upper(), what, f"{on - off:+.2f}", met])
    if not rows:
        return None
    return Table("Acceptance thresholds of the default", ["", "Requirement", "difference, dB", "met"], rows)


def _difference_groups(
    study: Study, kind: str, ours: str, other: str, densification: str, metric: str
) -> list[list[float]]:
    """Per-view differences for every scene and effect of a category, seeds pooled."""
    groups = []
    effects = {r.run.effect for r in study.results}
    for effect in sorted(effects):
        if not (category(effect) == kind or (kind == MEAN and effect != CLEAN)):
            continue
        for scene in study.scenes:
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
