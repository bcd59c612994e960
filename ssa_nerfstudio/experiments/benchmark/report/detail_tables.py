"""Tables that the paper lacks: every scene, the artifact itself, cost."""

from __future__ import annotations

import statistics as plain
from collections.abc import Callable

from ssa_nerfstudio.experiments.benchmark.report.bootstrap import spread
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import Study, finite
from ssa_nerfstudio.experiments.benchmark.report.table_cells import (
    NOTE,
    ROW_NAMES,
    format_pair,
)
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, category, title


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
    note = f"PSNR in dB, cells {' / '.join(d.upper() for d in study.densifications)}, ± over seeds. {NOTE}"
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
                    and category(r.run.effect) == kind
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


def _joined(cells: list[list[str]], means: list[float | None], choose: Callable) -> list[str]:
    """Cells ADC / MCMC with the best of all in bold."""
    best = choose((mean for mean in means if mean is not None), default=None)
    flat = iter(means)
    return [
        format_pair([f"**{text}**" if best is not None and next(flat) == best else text for text in parts])
        for parts in cells
    ]
