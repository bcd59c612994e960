"""Tables of the paper: results by category, sensitivity to the sparsity weight, ablation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import product

from ssa_nerfstudio.experiments.benchmark.report import paper_tables as paper
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import MEAN, METRICS, Study, Value
from ssa_nerfstudio.experiments.benchmark.report.table_cells import (
    FORMATS,
    HEADINGS,
    NOTE,
    densification_names,
    format_cells,
    format_pair,
    format_value,
    row_name,
)
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, METHODS, title

SENSITIVITY = ("l1-0", "l1-0.01", "l1-0.05")
ABLATION = {
    "l1-0": "No regularization",
    "paper": "L_sparse + statistics init",
    "constant-start": "L_sparse + const. init",
}
THE_PAPER = "  the paper"
"""First cell of a row with its figures."""
Published = dict[tuple[str, str, str], paper.Triple]


def results_by_category(study: Study, with_paper: bool) -> Table:
    """Table `results`: mean over the scenes of a category, cells ADC / MCMC."""
    published = paper.RESULTS if with_paper else {}
    ablated = (*SENSITIVITY, "constant-start")
    return _by_category(study, listed_methods(study, published, ablated), "Results by category", published)


def sensitivity(study: Study, with_paper: bool) -> Table | None:
    """Table `lambda`: a uniform sparsity weight; None where no such runs are there."""
    methods = [name for name in SENSITIVITY if name in study.methods]
    if not methods:
        return None
    published = paper.REAL_SENSITIVITY if study.real else paper.SENSITIVITY
    table = _by_category(study, methods, "Sensitivity to a uniform sparsity weight", published if with_paper else {})
    if "paper" in study.methods:
        rule = ["Mean, the paper's rule", *format_cells(study, MEAN, "paper", METRICS)]
        table.rows.append(rule + [""] * (len(table.headings) - len(rule)))
    return table


def ablation(study: Study, with_paper: bool) -> Table | None:
    """Table `ablation` with the mean color deviation; None where no such runs are there."""
    if not {"l1-0", "constant-start"} & set(study.methods):
        return None
    metrics = [*METRICS, "mean_color_deviation"]
    published = (paper.REAL_ABLATION if study.real else paper.ABLATION) if with_paper else {}
    rows = []
    for method, name in ABLATION.items():
        rows.append([name, *format_cells(study, MEAN, method, metrics)])
        known = not study.real and method in paper.COLOR_DEVIATION
        deviation = f"{paper.COLOR_DEVIATION[method]:.2f}" if known else ""
        for (of, densification), triple in published.items():
            if of == method:
                figures = {m: FORMATS[m].format(v) for m, v in zip(paper.METRICS, triple, strict=True)}
                shown = [figures.get(metric, "") for metric in METRICS]
                rows.append([f"{THE_PAPER}, {densification.upper()}", *shown, deviation])
    headings = ["Configuration", *(HEADINGS[metric] for metric in metrics)]
    return Table("Ablation", headings, rows, f"Mean over all artifacts; cells are {densification_names(study)}.")


def _by_category(study: Study, methods: list[str], name: str, published: Published) -> Table:
    columns = list(product(methods, METRICS))
    clean = [CLEAN] if any(r.run.effect == CLEAN for r in study.results) else []
    rows = []
    for kind in clean + study.kinds:
        values = {(m, metric): [study.value(kind, m, d, metric) for d in study.densifications] for m, metric in columns}
        best = {metric: best_of([v for m in methods for v in values[m, metric]], metric) for metric in METRICS}
        cells = [format_pair([format_value(v, c[1], best[c[1]]) for v in pair]) for c, pair in values.items()]
        rows.append([row_name(kind), *cells])
        if any(key[0] == kind for key in published):
            keys = [(kind, method) for method in methods]
            rows.append([THE_PAPER, *published_cells(published, keys, METRICS, study.densifications)])
    headings = ["Artifact", *(f"{title(method)} {HEADINGS[metric]}" for method, metric in columns)]
    return Table(name, headings, rows, f"Mean over scenes; cells {densification_names(study)}. {NOTE}")


def best_of(values: Iterable[Value | None], metric: str) -> str | None:
    """The best of a row and metric as a cell shows it; None where there is nothing to compare."""
    numbers = [value.mean for value in values if value is not None and not math.isnan(value.mean)]
    choose = min if metric == "flip" else max
    return FORMATS[metric].format(choose(numbers)) if len(numbers) > 1 else None


def published_cells(
    published: Published, keys: Sequence[tuple[str, str]], metrics: Iterable[str], densifications: list[str]
) -> list[str]:
    """The paper's cells for every (category or scene, method) and metric; empty where it has none."""
    cells = []
    for key, metric in product(keys, metrics):
        pairs = (zip(paper.METRICS, published.get((*key, d), ()), strict=False) for d in densifications)
        figures = [dict(pair) for pair in pairs]
        texts = [FORMATS[metric].format(figure[metric]) if metric in figure else "-" for figure in figures]
        cells.append("" if set(texts) == {"-"} else " / ".join(texts))
    return cells


def listed_methods(study: Study, published: Published, without: tuple[str, ...]) -> list[str]:
    """Methods that were run or that the paper has, in the matrix's order and candidates last."""
    known = {*study.methods, *(method for _, method, _ in published)} - {*without}
    return [name for name in METHODS if name in known] + [name for name in study.methods if name in known - {*METHODS}]
