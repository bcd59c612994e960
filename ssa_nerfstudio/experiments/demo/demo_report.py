"""The demonstration as files: a table, a picture sheet, one HTML page, results.json."""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from rich.table import Table

from ssa_nerfstudio.experiments.demo.comparison import Comparison, Demonstration

COLUMNS = (("psnr", "PSNR dB", "{:.2f}"), ("ssim", "SSIM", "{:.3f}"), ("flip", "FLIP", "{:.3f}"),
           ("mean_color_deviation", "mean color deviation", "{:.2f}"))  # fmt: skip
"""Metric, heading, format; higher is better for the first two."""
CORRUPTED = (
    "The test photos of this capture carry the artifact too (its transforms.json names no clean test_filenames): "
    "the figures compare a clean scene with corrupted photos, and a better removal can score lower. "
    "Look at the pictures."
)


def console_table(comparison: Comparison) -> Table:
    """The figures of one dataset for the terminal."""
    table = Table(title=f"{comparison.name}: the clean scene against held-out test views")
    for heading in ("", *(heading for _, heading, _ in COLUMNS), "Gaussians", "training s"):
        table.add_column(heading, justify="left" if not heading else "right", no_wrap=not heading)
    for row in _rows(comparison):
        table.add_row(*row)
    return table


def write_report(demonstration: Demonstration, output: Path, command: str) -> Path:
    """Write sheet.png, report.html and results.json into `output`; the page carries the command that made it.

    Returns:
        The page.
    """
    sheet = output / "sheet.png"
    _draw_sheet(demonstration, sheet)
    results = {**demonstration.results(), "command": command}
    (output / "results.json").write_text(json.dumps(results, indent=2) + "\n")
    page = output / "report.html"
    page.write_text(_page(demonstration, sheet, results))
    return page


def _rows(comparison: Comparison) -> list[list[str]]:
    return [
        [
            method,
            *(form.format(outcome.metrics[key]) for key, _, form in COLUMNS),
            f"{outcome.gaussians:,}",
            f"{outcome.seconds['training']:.1f}",
        ]
        for method, outcome in comparison.outcomes.items()
    ]


def _draw_sheet(demonstration: Demonstration, path: Path) -> None:
    rows, columns = len(demonstration.comparisons), len(demonstration.comparisons[0].pictures)
    height, width = next(iter(demonstration.comparisons[0].pictures.values())).shape[:2]
    size = (2.6 * columns, (2.6 * height / width + 0.35) * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for row, comparison in zip(axes, demonstration.comparisons, strict=True):
        for axis, (title, picture) in zip(row, comparison.pictures.items(), strict=True):
            axis.imshow(picture, interpolation="nearest")
            axis.set_title(title, fontsize=9)
            axis.set_xticks([])
            axis.set_yticks([])
        row[0].set_ylabel(comparison.name, fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _page(demonstration: Demonstration, sheet: Path, results: dict) -> str:
    headings = "".join(f"<th>{h}</th>" for h in ("", *(h for _, h, _ in COLUMNS), "Gaussians", "training s"))
    sections = []
    for comparison in demonstration.comparisons:
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in _rows(comparison)
        )
        note = "" if comparison.clean_test_views else f"<p class=note>{CORRUPTED}</p>"
        config = html.escape(comparison.configs["ssa-splatfacto"])
        sections.append(
            f"<h2>{html.escape(comparison.name)}</h2>{note}<table><tr>{headings}</tr>{rows}</table>"
            f"<p>Look at it: <code>ns-viewer --load-config {config}</code></p>"
        )
    picture = base64.b64encode(sheet.read_bytes()).decode()
    made_with = ", ".join(f"{name} {value}" for name, value in results["versions"].items())
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>SSA-Nerfstudio demo</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #222 }}
img {{ width: 100%; height: auto }} table {{ border-collapse: collapse }}
td, th {{ padding: .3rem .9rem; border-bottom: 1px solid #ccc; text-align: right }}
td:first-child {{ text-align: left }} .note {{ background: #fff3cd; padding: .6rem 1rem }} code {{ font-size: .85em }}
</style>
<h1>The same photos, without and with the overlay</h1>
<p>Both rows are the same model with the same settings; the second learns the artifact as a picture in front of the
scene. Figures compare the splats, drawn without the artifact, with test views that no training saw.</p>
<img alt="training photo, test photo, both renders, learned artifact and matte, a row for each dataset"
 src="data:image/png;base64,{picture}">
{"".join(sections)}
<p>Made by <code>{html.escape(results["command"])}</code> with {html.escape(made_with)}.</p>
</html>
"""
