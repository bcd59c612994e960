"""Tables of the paper for captures that carry an artifact themselves: methods by category, and every scene."""

from __future__ import annotations

import math
from itertools import product

from ssa_nerfstudio.experiments.benchmark.report import paper_tables as paper
from ssa_nerfstudio.experiments.benchmark.report.category_tables import (
    SENSITIVITY,
    THE_PAPER,
    best_of,
    listed_methods,
    published_cells,
)
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import Study, Value, mean
from ssa_nerfstudio.experiments.benchmark.report.table_cells import (
    HEADINGS,
    MARKS,
    NOTE,
    densification_names,
    format_pair,
    format_value,
    row_name,
)
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import category, title


def real_by_method(study: Study, with_paper: bool) -> Table:
    """Table `real`: a row for each method, categories side by side, and the mean over all scenes."""
    published = paper.REAL if with_paper else {}
    methods = listed_methods(study, published, (*SENSITIVITY, "constant-start"))
    columns = list(product(study.kinds, paper.METRICS))
    metrics = [metric for _, metric in columns]
    values = {
        method: [[study.value(kind, method, d, metric) for d in study.densifications] for kind, metric in columns]
        for method in methods
    }
    best = [best_of((v for cells in values.values() for v in cells[n]), m) for n, m in enumerate(metrics)]
    rows = []
    for method, cells in values.items():
        rows.append([title(method), *_shown(cells, metrics, best)])
        keys = [(kind, method) for kind in study.kinds]
        rows += _of_paper([THE_PAPER], published_cells(published, keys, paper.METRICS, study.densifications))
    headings = ["Method", *(f"{row_name(kind)} {HEADINGS[metric]}" for kind, metric in columns)]
    note = f"Mean over scenes; cells {densification_names(study)}. {MARKS} Best of a column in bold."
    return Table("Results on captured artifacts", headings, rows, note)


def real_by_scene(study: Study, with_paper: bool) -> Table:
    """Table `real_perscene`: a row for each scene, methods side by side, the ablations among them."""
    published = paper.REAL_BY_SCENE if with_paper else {}
    methods = listed_methods(study, published, SENSITIVITY[1:])
    columns, rows = list(product(methods, paper.METRICS)), []
    metrics = [metric for _, metric in columns]
    for effect, scene in study.pairs:
        cells = [[_of_scene(study, effect, scene, *column, d) for d in study.densifications] for column in columns]
        same = {m: cells[n :: len(paper.METRICS)] for n, m in enumerate(paper.METRICS)}
        best = [best_of((value for pair in same[m] for value in pair), m) for m in metrics]
        rows.append([row_name(category(effect)), scene, *_shown(cells, metrics, best)])
        keys = [(scene, method) for method in methods]
        rows += _of_paper([THE_PAPER, ""], published_cells(published, keys, paper.METRICS, study.densifications))
    headings = ["Artifact", "Scene", *(f"{title(method)} {HEADINGS[metric]}" for method, metric in columns)]
    note = f"Mean over seeds; cells {densification_names(study)}. {NOTE}"
    return Table("Captured artifacts by scene", headings, rows, note)


def _of_scene(study: Study, effect: str, scene: str, method: str, metric: str, densification: str) -> Value | None:
    """Mean of a metric over the seeds of one scene; None where there is nothing to average."""
    chosen = study.select(effect, scene, method, densification)
    figure, diverged = mean(chosen, metric), sum(r.status == "diverged" for r in chosen)
    if figure is None and not diverged:
        return None
    return Value(math.nan if figure is None else figure, scenes=1, planned=1, diverged=diverged)


def _shown(cells: list[list[Value | None]], metrics: list[str], best: list[str | None]) -> list[str]:
    each = zip(cells, metrics, best, strict=True)
    return [format_pair([format_value(value, metric, top) for value in pair]) for pair, metric, top in each]


def _of_paper(names: list[str], cells: list[str]) -> list[list[str]]:
    """A row of the paper's figures, or none where it has none."""
    return [[*names, *cells]] if any(cells) else []
