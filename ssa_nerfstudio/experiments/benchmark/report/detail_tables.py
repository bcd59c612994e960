"""Tables that the paper lacks: every scene, the artifact itself, cost."""

from __future__ import annotations

import statistics
from itertools import product

from ssa_nerfstudio.experiments.benchmark.report.bootstrap import spread
from ssa_nerfstudio.experiments.benchmark.report.document import Table
from ssa_nerfstudio.experiments.benchmark.report.study import Study, finished_values, finite, mean
from ssa_nerfstudio.experiments.benchmark.report.table_cells import NOTE, densification_names, format_pair, row_name
from ssa_nerfstudio.experiments.benchmark.results import STAGES, Result
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import category, title

PSNR_OVER_VIEWS = {"psnr": "mean", "psnr median": "median", "psnr worst": "worst view"}
MATTES = {"matte_inside": "matte inside", "matte_outside": "outside", "matte_upper_third": "upper third"}
ARTIFACT_SCORES = {
    "matte_error": "matte error ↓",
    "matte_iou": "IoU at 0.5 ↑",
    "premultiplied_error": "color error ↓",
    "transmittance_error": "transmittance error ↓",
}


def results_by_scene(study: Study) -> Table:
    """PSNR of every scene behind every artifact, cells ADC / MCMC, mean over seeds ± their standard deviation."""
    rows = []
    for subject, (metric, name) in product(study.subjects, PSNR_OVER_VIEWS.items()):
        cells = [[study.select(*subject, m, d) for d in study.densifications] for m in study.methods]
        best = max(finite(mean(chosen, metric) for pair in cells for chosen in pair), default=None)
        if best is not None:
            shown = (format_pair([_over_seeds(chosen, metric, best) for chosen in pair]) for pair in cells)
            rows.append([*subject, name, *shown])
    headings = ["Artifact", "Scene", "over views", *map(title, study.methods)]
    note = f"PSNR in dB, cells {densification_names(study)}, ± over seeds. {NOTE}"
    return Table("Results by scene", headings, rows, note)


def by_mask(study: Study) -> Table | None:
    """Scores by a mask of the photos' own artifact, mean over seeds; None where no scene states one."""
    metrics = [f"outside_{metric}" for metric in PSNR_OVER_VIEWS]
    # Photos with the artifact say nothing about what is behind it, and all about the composite.
    metrics += ["inside_psnr"] if study.clean_tests else [f"composite_{metric}" for metric in PSNR_OVER_VIEWS]
    rows = []
    for subject in study.subjects:
        masked = [r for r in study.results if (r.run.effect, r.run.scene) == subject and r.run.mask]
        for method, densification, chosen in study.rows(masked):
            # Without an overlay the clean render is the composite.
            figures = [mean(chosen, m) or mean(chosen, m.removeprefix("composite_")) for m in metrics]
            # Earlier results of baselines state mattes of 0, though these learn no overlay.
            mattes = [finite(r.artifact.get(name) for r in chosen if not r.run.baseline) for name in MATTES]
            cells = ["-" if figure is None else f"{figure:.2f}" for figure in figures]
            cells += [f"{statistics.mean(values):.3f}" if values else "" for values in mattes]
            rows.append([*subject, title(method), densification.upper(), *cells])
    if not rows:
        return None
    headings = ["outside: PSNR ↑", "median", "worst view"]
    headings += ["inside: PSNR ↑"] if study.clean_tests else ["composite: PSNR ↑", "median", "worst view"]
    note = (
        "Outside: of the clean render, of pixels farther from the mask than 16 pixels of a photo. Composite: of all "
        "pixels, against photos that show the artifact. Mean mattes inside the mask, outside, and outside in the upper "
        "third; 0 where detection found no artifact."
    )
    headings = ["Artifact", "Scene", "Method", "", *headings, *MATTES.values()]
    return Table("By a mask of the artifact", headings, rows, note)


def by_exposure(study: Study) -> Table | None:
    """PSNR before and after color correction, of scenes whose exposure varies; None where none does."""
    rows = []
    for subject in study.subjects:
        varying = [r for r in study.results if (r.run.effect, r.run.scene) == subject and r.run.exposure]
        for method, densification, chosen in study.rows(varying):
            means = [mean(chosen, metric) for metric in ("psnr", "cc_psnr", "mean_color_deviation")]
            cells = ["-" if value is None else f"{value:.2f}" for value in means]
            rows.append([*subject, title(method), densification.upper(), *cells])
    if not rows:
        return None
    note = (
        "Test photos are at the mean exposure. Corrected: the render of each test view is brought to its photo by a "
        "gain and an offset per channel."
    )
    headings = ["Artifact", "Scene", "Method", "", "PSNR ↑", "corrected PSNR ↑", "mean color deviation ↓"]
    return Table("Under varying exposure", headings, rows, note)


def artifact_itself(study: Study) -> Table | None:
    """How well the artifact came out; None where no overlay was learned in front of known layers."""
    rows = []
    for kind in study.categories:
        scored = [r for r in study.results if "matte_iou" in r.artifact and category(r.run.effect) == kind]
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


def _over_seeds(results: list[Result], metric: str, best: float) -> str:
    """Mean ± standard deviation over seeds; † where one diverged, bold where it is the best."""
    value, deviation = mean(results, metric), spread(finished_values(results, metric))
    text = "-" if value is None else f"{value:.2f}"
    if deviation is not None:
        text += f" ± {deviation:.2f}"
    text += "†" * any(r.status == "diverged" for r in results)
    return f"**{text}**" if value == best else text
