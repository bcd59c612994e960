"""The demonstration as files: a table, a picture sheet, one HTML page, results.json."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from rich.table import Table

from ssa_nerfstudio.data.writing import staged_file, unwritable_as_input_error, write_text
from ssa_nerfstudio.experiments.demo.comparison import Comparison, Demonstration
from ssa_nerfstudio.workflow.html_page import render_page

COLUMNS = (("psnr", "PSNR dB", "{:.2f}"), ("ssim", "SSIM", "{:.3f}"), ("flip", "FLIP", "{:.3f}"),
           ("mean_color_deviation", "mean color deviation", "{:.2f}"))  # fmt: skip
"""Metric, heading, format; higher is better for the first two."""
HEADINGS = ["", *(heading for _, heading, _ in COLUMNS), "Gaussians", "training s"]
CORRUPTED = (
    "The test photos of this capture carry the artifact too (its transforms.json names no clean test_filenames): "
    "the metrics compare a clean scene with corrupted photos, and a better removal can score lower. "
    "Look at the pictures."
)


def console_table(comparison: Comparison) -> Table:
    """The metrics of one dataset for the terminal."""
    table = Table(title=f"{comparison.name}: the clean scene against held-out test views")
    for heading in HEADINGS:
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
    write_text(output / "results.json", json.dumps(results, indent=2) + "\n")
    page = output / "report.html"
    write_text(page, _page(demonstration, sheet, results))
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
    with unwritable_as_input_error(path), staged_file(path) as part:
        figure.savefig(part, format="png", dpi=110)
    plt.close(figure)


def _page(demonstration: Demonstration, sheet: Path, results: dict) -> str:
    return render_page(
        Path(__file__).parents[1] / "templates/demo.html",
        "The same photos, without and with the overlay",
        sheet=sheet,
        headings=HEADINGS,
        comparisons=[(comparison, _rows(comparison)) for comparison in demonstration.comparisons],
        corrupted=CORRUPTED,
        command=results["command"],
        made_with=", ".join(f"{name} {value}" for name, value in results["versions"].items()),
    )
