"""The paper's tables in its own layout, and those it lacks: the artifact itself, paired differences, seeds, cost."""

from __future__ import annotations

import math
import statistics as plain
from collections.abc import Callable

from ssa_nerfstudio.experiments.benchmark.report import paper_tables as paper
from ssa_nerfstudio.experiments.benchmark.report.bootstrap import bootstrap, paired_differences, spread
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import MEAN, METRICS, Study, Value, finite
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, title

HEADINGS = {
    "psnr": "PSNR ↑",
    "ssim": "SSIM ↑",
    "flip": "FLIP ↓",
    "mean_color_deviation": "color deviation ↓",
}
FORMATS = {"psnr": "{:.2f}", "ssim": "{:.3f}", "flip": "{:.3f}", "mean_color_deviation": "{:.2f}"}
ROW_NAMES = {CLEAN: "Clean (Ref)", MEAN: "Mean", "ui": "UI elements", "rain": "Rain spots"}
SENSITIVITY = ("l1-0", "l1-0.01", "l1-0.05")
ABLATION = {
    "l1-0": "No regularization",
    "paper": "L_sparse + statistics init",
    "constant-start": "L_sparse + const. init",
}
MAIN_METHODS = ("3dgs", "default", "overlay-on", "paper", "given")
_NOTE = "† a run diverged and is left out; (n/m): n of m scenes are there. Best of a row and metric in bold."


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
        rule = [_pair([_cell(study.value(MEAN, "paper", d, m), m) for d in study.densifications]) for m in METRICS]
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
            _pair([_cell(study.value(MEAN, method, d, metric), metric) for d in study.densifications])
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


def results_by_scene(study: Study) -> Table:
    """PSNR of every scene behind every artifact, cells ADC / MCMC, mean over seeds ± their standard deviation."""
    rows = []
    for effect, scene in [*study.pairs, *((CLEAN, scene) for scene in study.scenes)]:
        cells, means = [], []
        for method in study.methods:
            parts = []
            for densification in study.densifications:
                chosen = study.select(effect, scene, method, densification)
                values = finite(r.metrics.get("psnr") for r in chosen if r.status == "finished")
                deviation = spread(values)
                text = f"{plain.mean(values):.2f}" if values else "-"
                means.append(plain.mean(values) if values else None)
                if deviation is not None:
                    text += f" ± {deviation:.2f}"
                parts.append(text + "†" * any(r.status == "diverged" for r in chosen))
            cells.append(parts)
        if any(mean is not None for mean in means):
            rows.append([effect, scene, *_joined(cells, means, max)])
    headings = ["Artifact", "Scene", *map(title, study.methods)]
    note = f"PSNR in dB, cells {' / '.join(d.upper() for d in study.densifications)}, ± over seeds. {_NOTE}"
    return Table("Results by scene", headings, rows, note)


def artifact_itself(study: Study) -> Table | None:
    """How well the artifact came out; None where no overlay was learned in front of known layers."""
    names = {
        "matte_error": "matte error ↓",
        "matte_iou": "IoU at 0.5 ↑",
        "premultiplied_error": "color error ↓",
        "transmittance_error": "transmittance error ↓",
    }
    rows = []
    for kind in study.categories:
        for method in study.methods:
            for densification in study.densifications:
                chosen = [
                    r
                    for r in study.results
                    if r.artifact
                    and r.run.effect.split("-")[0] == kind
                    and (r.run.method, r.run.densification) == (method, densification)
                ]
                if chosen:
                    means = [f"{plain.mean(r.artifact[name] for r in chosen):.3f}" for name in names]
                    rows.append([ROW_NAMES.get(kind, kind.capitalize()), title(method), densification.upper(), *means])
    if not rows:
        return None
    note = (
        "Against the true layers, mean over scenes and seeds. Matte: A against the least opacity that explains the "
        "artifact, max over channels of 1 - T and B. Color: premultiplied A W against B. Mean absolute errors."
    )
    return Table("The artifact itself", ["Artifact", "Method", "", *names.values()], rows, note)


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


def bar(study: Study) -> Table | None:
    """What the default is held to; None where it was not run."""
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
            what = f"{scene}, {effect}: better of paper's rule and given, minus 0.2"
            rows.append([densification.upper(), what, f"{ours - best:+.2f}", met])
            if given is not None:
                differences.append(ours - given)
        if differences:
            mean = plain.mean(differences)
            met = "yes" if mean >= 0 else "**no**"
            rows.append([densification.upper(), "mean over all: not below given", f"{mean:+.2f}", met])
        for scene in study.scenes:
            on, off = psnr(CLEAN, scene, "overlay-on"), psnr(CLEAN, scene, "3dgs")
            if on is not None and off is not None:
                met = "yes" if on >= off - 0.1 else "**no**"
                what = f"{scene}, clean: overlay on within 0.1 of off"
                rows.append([densification.upper(), what, f"{on - off:+.2f}", met])
    if not rows:
        return None
    return Table("The bar for the default", ["", "Requirement", "difference, dB", "met"], rows)


def cost(study: Study) -> Table | None:
    """Seconds, memory and Gaussians by method, of runs that had their device to themselves; None without such."""
    rows = []
    for method in study.methods:
        for densification in study.densifications:
            chosen = [
                r
                for r in study.results
                if r.alone and r.status == "finished" and (r.run.method, r.run.densification) == (method, densification)
            ]
            if chosen:
                seconds = [
                    f"{plain.mean(r.seconds[stage] for r in chosen):.1f}"
                    for stage in ("startup", "statistics", "training", "evaluation")
                ]
                rows.append(
                    [
                        title(method),
                        densification.upper(),
                        *seconds,
                        f"{plain.mean(r.gaussians for r in chosen):,.0f}",
                        f"{plain.mean(r.peak_memory_mb for r in chosen):,.0f}",
                        str(len(chosen)),
                    ]
                )
    if not rows:
        return None
    headings = [
        "Method",
        "",
        "start-up s",
        "statistics s",
        "training s",
        "evaluation s",
        "Gaussians",
        "peak MB",
        "runs",
    ]
    return Table("Cost", headings, rows, "Means over the runs that had their device to themselves.")


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
                row.append(_pair([_cell(value, metric, best[metric]) for value in values[method, metric]]))
        rows.append(row)
        if any(key[0] == kind for key in published):
            rows.append(["  the paper", *_published(published, kind, methods, study.densifications)])
    headings = ["Artifact", *(f"{title(method)} {HEADINGS[metric]}" for method in methods for metric in METRICS)]
    note = f"Mean over scenes; cells {' / '.join(d.upper() for d in study.densifications)}. {_NOTE}"
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


def _cell(value: Value | None, metric: str, best: str | None = None) -> str:
    if value is None:
        return "-"
    text = "-" if math.isnan(value.mean) else FORMATS[metric].format(value.mean)
    if text == best:
        text = f"**{text}**"
    if value.scenes + (1 if value.diverged else 0) < value.planned:
        text += f" ({value.scenes}/{value.planned})"
    return text + "†" * bool(value.diverged)


def _joined(cells: list[list[str]], means: list[float | None], choose: Callable) -> list[str]:
    """Cells ADC / MCMC with the best of all in bold."""
    best = choose((mean for mean in means if mean is not None), default=None)
    flat = iter(means)
    return [
        _pair([f"**{text}**" if best is not None and next(flat) == best else text for text in parts]) for parts in cells
    ]


def _pair(parts: list[str]) -> str:
    """ADC / MCMC, or one dash where there is neither."""
    return "-" if set(parts) == {"-"} else " / ".join(parts)


def _difference_groups(
    study: Study, kind: str, ours: str, other: str, densification: str, metric: str
) -> list[list[float]]:
    """Per-view differences for every scene and effect of a category, seeds pooled."""
    groups = []
    effects = {r.run.effect for r in study.results}
    for effect in sorted(effects):
        if not (effect.split("-")[0] == kind or (kind == MEAN and effect != CLEAN)):
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
