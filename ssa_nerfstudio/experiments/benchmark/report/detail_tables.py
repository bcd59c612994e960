"""Tables that the paper lacks: every scene, the artifact itself, cost."""

from __future__ import annotations

import statistics

from ssa_nerfstudio.experiments.benchmark.report.bootstrap import spread
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import Study, finished_values, finite, mean
from ssa_nerfstudio.experiments.benchmark.report.table_cells import NOTE, densification_names, format_pair, row_name
from ssa_nerfstudio.experiments.benchmark.results import STAGES, Result
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import category, title

ARTIFACT_SCORES = {
    "matte_error": "matte error ↓",
    "matte_iou": "IoU at 0.5 ↑",
    "premultiplied_error": "color error ↓",
    "transmittance_error": "transmittance error ↓",
}


def results_by_scene(study: Study) -> Table:
    """PSNR of every scene behind every artifact, cells ADC / MCMC, mean over seeds ± their standard deviation."""
    rows = []
    for subject in study.subjects:
        cells = [[study.select(*subject, m, d) for d in study.densifications] for m in study.methods]
        best = max(finite(mean(chosen, "psnr") for pair in cells for chosen in pair), default=None)
        if best is not None:
            rows.append([*subject, *(format_pair([_psnr(chosen, best) for chosen in pair]) for pair in cells)])
    headings = ["Artifact", "Scene", *map(title, study.methods)]
    note = f"PSNR in dB, cells {densification_names(study)}, ± over seeds. {NOTE}"
    return Table("Results by scene", headings, rows, note)


def artifact_itself(study: Study) -> Table | None:
    """How well the artifact came out; None where no overlay was learned in front of known layers."""
    rows = []
    for kind in study.categories:
        scored = [r for r in study.results if r.artifact and category(r.run.effect) == kind]
        for method, densification, chosen in study.rows(scored):
            scores = [f"{statistics.mean(r.artifact[name] for r in chosen):.3f}" for name in ARTIFACT_SCORES]
            rows.append([row_name(kind), title(method), densification.upper(), *scores])
    if not rows:
        return None
    note = (
        "Against the true layers, mean over scenes and seeds. Matte: A against the least opacity that explains the "
        "artifact, max over channels of 1 - T and B. Color: premultiplied A W against B. Mean absolute errors."
    )
    return Table("The artifact itself", ["Artifact", "Method", "", *ARTIFACT_SCORES.values()], rows, note)


def cost(study: Study) -> Table | None:
    """Seconds, memory and Gaussians by method, of runs that had their device to themselves; None without such."""
    rows = []
    for method, densification, chosen in study.rows([r for r in study.results if r.alone and r.status == "finished"]):
        seconds = [f"{statistics.mean(r.seconds[stage] for r in chosen):.1f}" for stage in STAGES]
        sizes = [f"{statistics.mean(getattr(r, n) for r in chosen):,.0f}" for n in ("gaussians", "peak_memory_mb")]
        rows.append([title(method), densification.upper(), *seconds, *sizes, str(len(chosen))])
    if not rows:
        return None
    stages = ["start-up s", "statistics s", "training s", "evaluation s"]
    headings = ["Method", "", *stages, "Gaussians", "peak MB", "runs"]
    return Table("Cost", headings, rows, "Means over the runs that had their device to themselves.")


def _psnr(results: list[Result], best: float) -> str:
    """Mean ± standard deviation over seeds; † where one diverged, bold where it is the best."""
    value, deviation = mean(results, "psnr"), spread(finished_values(results, "psnr"))
    text = "-" if value is None else f"{value:.2f}"
    if deviation is not None:
        text += f" ± {deviation:.2f}"
    text += "†" * any(r.status == "diverged" for r in results)
    return f"**{text}**" if value == best else text
