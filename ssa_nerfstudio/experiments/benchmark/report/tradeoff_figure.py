"""The frontier as a figure: all runs and what none beats on top, a panel for every knob below."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ssa_nerfstudio.data.writing import staged_file, unwritable_as_input_error
from ssa_nerfstudio.experiments.benchmark.report.frontier import knee
from ssa_nerfstudio.experiments.benchmark.report.tradeoff_curves import Curve, Subject

COLUMNS = 3
"""Panels of knobs in a row."""
TOGETHER = "several together"
KNOBS = {
    "steps": "length of the training",
    "image_scale": "size of the training photos",
    "overlay_downscale": "overlay smaller by",
    "densification": "how Gaussians multiply",
    "cap_max": "number of Gaussians",
    "sparsity": "what keeps the matte sparse",
    "ssim_lambda": "weight of the SSIM term",
    "rasterizer": "what draws the splats",
}
"""For people who do not know the options by their names."""
COLORS = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#7f7f00", "#8c564b", "#4d4d4d", "#8a2be2", "#bcbd22", "#17becf"),
)
"""Okabe and Ito's, which most color-blind people tell apart, and some more."""


def draw(subject: Subject, folder: Path) -> list[Path]:
    """Writes NAME.png and NAME.svg; the two files, PNG first."""
    knobs = subject.knobs
    together = any(len(curve.knobs) > 1 for curve in subject.curves)
    rows = math.ceil(len(knobs) / COLUMNS)
    figure = plt.figure(figsize=(11, 5 + 2.9 * (rows + together)), layout="constrained")
    grid = figure.add_gridspec(1 + rows + together, COLUMNS, height_ratios=[1.7, *([1] * (rows + together))])
    top = figure.add_subplot(grid[0, :])
    _overview(top, subject)
    for number, name in enumerate(knobs):
        axes = figure.add_subplot(grid[1 + number // COLUMNS, number % COLUMNS], sharex=top, sharey=top)
        _panel(axes, subject, name)
    if together:
        axes = figure.add_subplot(grid[-1, :2], sharex=top, sharey=top)
        _panel(axes, subject, TOGETHER)
        legend = axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))
        legend.set_in_layout(False)
    paths = [folder / f"{subject.name}.{kind}" for kind in ("png", "svg")]
    for path in paths:
        kind = path.suffix[1:]
        with unwritable_as_input_error(path), staged_file(path) as part:
            figure.savefig(part, format=kind, dpi=130, metadata={"Date": None} if kind == "svg" else None)
    plt.close(figure)
    return paths


def _overview(axes: Axes, subject: Subject) -> None:
    for curve in subject.curves:
        _line(axes, curve, color="0.75", linewidth=1, marker=".", markersize=4)
    front = subject.front()
    seconds, quality = [p.seconds for p in front], [p.quality for p in front]
    if front:
        label = "frontier: no run reached more in less time"
        axes.plot(seconds, quality, color="black", linewidth=2, marker="o", markersize=4, label=label)
    bend = knee(front)
    if bend is not None:
        curve, entry = subject.whose(bend)
        axes.plot([bend.seconds], [bend.quality], "o", color="#d55e00", markersize=11, zorder=5)
        axes.annotate(
            f"knee: {bend.quality:.2f} dB after {_seconds(bend.seconds)}\n{curve.setting}, step {entry['step']:.0f}",
            (bend.seconds, bend.quality),
            # Curves rise from the lower left: below them, at the right, nothing is hidden.
            xytext=(0.985, 0.28),
            textcoords="axes fraction",
            horizontalalignment="right",
            color="#a04000",
            arrowprops={"arrowstyle": "-", "color": "#d55e00", "relpos": (0, 0.5)},
        )
    axes.plot([], [], color="0.75", marker=".", label="every run, from first to last evaluation")
    if len(subject.alone) < len(subject.curves):
        label = "shared its device: seconds too long, on no frontier"
        axes.plot([], [], color="0.75", marker=".", linestyle=":", label=label)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(10, (1, 3)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _seconds(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_title(f"What accuracy costs: {subject.scene} behind {subject.effect}, on {subject.device}", pad=20)
    axes.text(0.5, 1.015, subject.around, transform=axes.transAxes, fontsize=9, horizontalalignment="center")
    axes.set_xlabel("time of statistics and training (logarithmic)")
    axes.set_ylabel("PSNR of clean test views, dB")
    axes.legend(loc="lower right", frameon=False)
    axes.grid(alpha=0.25)


def _panel(axes: Axes, subject: Subject, name: str) -> None:
    """The runs that vary one knob, or several, colored, before all others."""
    chosen = [c for c in subject.curves if not c.knobs or c.knobs == (name,)]
    if name == TOGETHER:
        chosen = [c for c in subject.curves if len(c.knobs) != 1]
    for curve in subject.curves:
        _line(axes, curve, color="0.88", linewidth=1)
    labelled: dict[str, str] = {}
    for curve in chosen:
        label = curve.setting if name == TOGETHER else curve.value(name) + ("" if curve.knobs else " (base)")
        fresh = label not in labelled
        color = labelled.setdefault(label, COLORS[len(labelled) % len(COLORS)])
        _line(axes, curve, color=color, marker="o", markersize=3, label=textwrap.fill(label, 44) if fresh else None)
    axes.set_title(f"{KNOBS[name]} ({name})" if name in KNOBS else name, fontsize=10)
    # Long names must not squeeze the panels.
    axes.legend(fontsize=7, frameon=False, loc="lower right").set_in_layout(False)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.2)


def _line(axes: Axes, curve: Curve, **style) -> None:
    points = curve.points
    line = "-" if curve.result.alone else ":"
    axes.plot([p["seconds"] for p in points], [p["psnr"] for p in points], linestyle=line, **style)


def _seconds(value: float) -> str:
    return f"{value / 60:.3g} min" if value >= 600 else f"{value:.3g} s"
