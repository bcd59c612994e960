"""Differences between methods, paired by test view."""

from __future__ import annotations

from itertools import product

from ssa_nerfstudio.experiments.benchmark.report.bootstrap import bootstrap, paired_differences
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import OVER_VIEWS, Study, belongs
from ssa_nerfstudio.experiments.benchmark.report.table_cells import FORMATS, row_name
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, METHODS, title

PAIRED = ("psnr", "ssim", "flip")
_BASELINES = tuple(name for name, method in METHODS.items() if method.baseline)
MAIN_METHODS = ("3dgs", "default", "overlay-on", "paper", "given", *_BASELINES)


def paired(study: Study, ours: str) -> Table | None:
    """Differences of one method to the others, paired view by view, with bootstrap intervals; None without pairs."""
    others = [name for name in MAIN_METHODS if name != ours and name in study.methods]
    rows = []
    for other, densification, kind in product(others, study.densifications, [*study.kinds, CLEAN]):
        groups = {m: _difference_groups(study, kind, ours, other, densification, m) for m in PAIRED}
        if any(groups.values()):
            name = "Clean photos" if kind == CLEAN else row_name(kind)
            cells = [_interval(group, metric) for metric, group in groups.items()]
            decibels = [value for group in groups["psnr"] for value in group]
            extent = [f"{over(decibels):+.2f}" if decibels else "" for over in OVER_VIEWS.values()]
            rows.append([f"minus {title(other)}", densification.upper(), name, cells[0], *extent, *cells[1:]])
    if not rows:
        return None
    note = (
        "Paired by test view and seed; mean over scenes, with 95 % bootstrap intervals over test views: what other "
        "views of the same scenes would change, not what other scenes would."
    )
    headings = ["", "", "Artifact", "PSNR", *(f"PSNR, {over}" for over in OVER_VIEWS), "SSIM", "FLIP"]
    return Table(f"{title(ours)}: paired differences", headings, rows, note)


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
