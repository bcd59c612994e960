"""Tables of the paper: results by category, sensitivity to the sparsity weight, ablation."""

from __future__ import annotations

import math

from ssa_nerfstudio.experiments.benchmark.report import paper_tables as paper
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import MEAN, METRICS, Study
from ssa_nerfstudio.experiments.benchmark.report.table_cells import (
    FORMATS,
    HEADINGS,
    NOTE,
    ROW_NAMES,
    format_pair,
    format_value,
)
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, title

SENSITIVITY = ("l1-0", "l1-0.01", "l1-0.05")
ABLATION = {
    "l1-0": "No regularization",
    "paper": "L_sparse + statistics init",
    "constant-start": "L_sparse + const. init",
}


def results_by_category(study: Study, with_paper: bool) -> Table:
    """Table `results`: mean over the scenes of a category, cells ADC / MCMC."""
    real = all(result.run.real for result in study.results)
    published = paper.REAL if real else paper.RESULTS
    return _by_category(
        study,
        [name for name in study.methods if name not in SENSITIVITY and name != "constant-start"],
        "Results by category",
        published if with_paper else {},
    )


def sensitivity(study: Study, with_paper: bool) -> Table | None:
    """Table `lambda`: a uniform sparsity weight; None where no such runs are there."""
    methods = [name for name in SENSITIVITY if name in study.methods]
    if not methods:
        return None
    real = all(result.run.real for result in study.results)
    published = paper.REAL_SENSITIVITY if real else paper.SENSITIVITY
    table = _by_category(study, methods, "Sensitivity to a uniform sparsity weight", published if with_paper else {})
    if "paper" in study.methods:
        rule = [
            format_pair([format_value(study.value(MEAN, "paper", d, m), m) for d in study.densifications])
            for m in METRICS
        ]
        blank = [""] * (len(table.headings) - 1 - len(METRICS))
        table.rows.append(["Mean, the paper's rule", *rule, *blank])
    return table


def ablation(study: Study, with_paper: bool) -> Table | None:
    """Table `ablation` with the mean color deviation; None where no such runs are there."""
    if not {"l1-0", "constant-start"} & set(study.methods):
        return None
    metrics = [*METRICS, "mean_color_deviation"]
    densifications = " / ".join(d.upper() for d in study.densifications)
    rows = []
    for method, name in ABLATION.items():
        cells = [
            format_pair([format_value(study.value(MEAN, method, d, metric), metric) for d in study.densifications])
            for metric in metrics
        ]
        rows.append([name, *cells])
        real = all(result.run.real for result in study.results)
        published = paper.REAL_ABLATION if real else paper.ABLATION
        for (of, densification), triple in published.items():
            if with_paper and of == method:
                deviation = (
                    "" if real or method not in paper.COLOR_DEVIATION else f"{paper.COLOR_DEVIATION[method]:.2f}"
                )
                figures = [FORMATS[m].format(v) for m, v in zip(METRICS, triple, strict=True)]
                rows.append(
                    [f"  the paper, {densification.upper()}", *figures, f"{deviation:.2f}" if deviation else ""]
                )
    headings = ["Configuration", *(HEADINGS[metric] for metric in metrics)]
    return Table("Ablation", headings, rows, f"Mean over all artifacts; cells are {densifications}.")


def _by_category(
    study: Study, methods: list[str], name: str, published: dict[tuple[str, str, str], paper.Triple]
) -> Table:
    kinds = [*([CLEAN] if any(r.run.effect == CLEAN for r in study.results) else []), *study.categories]
    kinds += [MEAN] if len(study.categories) > 1 else []
    rows = []
    for kind in kinds:
        values = {
            (method, metric): [study.value(kind, method, d, metric) for d in study.densifications]
            for method in methods
            for metric in METRICS
        }
        row = [ROW_NAMES.get(kind, kind.capitalize())]
        best = {}
        for metric in METRICS:
            numbers = [v.mean for method in methods for v in values[method, metric] if v and not math.isnan(v.mean)]
            choose = min if metric == "flip" else max
            best[metric] = FORMATS[metric].format(choose(numbers)) if len(numbers) > 1 else None
        for method in methods:
            for metric in METRICS:
                row.append(format_pair([format_value(value, metric, best[metric]) for value in values[method, metric]]))
        rows.append(row)
        if any(key[0] == kind for key in published):
            rows.append(["  the paper", *_published(published, kind, methods, study.densifications)])
    headings = ["Artifact", *(f"{title(method)} {HEADINGS[metric]}" for method in methods for metric in METRICS)]
    note = f"Mean over scenes; cells {' / '.join(d.upper() for d in study.densifications)}. {NOTE}"
    return Table(name, headings, rows, note)


def _published(
    published: dict[tuple[str, str, str], paper.Triple], kind: str, methods: list[str], densifications: list[str]
) -> list[str]:
    cells = []
    for method in methods:
        for number, metric in enumerate(METRICS):
            triples = [published.get((kind, method, d)) for d in densifications]
            texts = [FORMATS[metric].format(triple[number]) if triple else "-" for triple in triples]
            cells.append(" / ".join(texts) if any(triples) else "")
    return cells
