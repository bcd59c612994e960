"""Headings and cells that the tables of a report share."""

from __future__ import annotations

import math
from collections.abc import Iterable

from ssa_nerfstudio.experiments.benchmark.report.study import MEAN, Study, Value
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN

HEADINGS = {
    "psnr": "PSNR ↑",
    "psnr median": "median",
    "psnr worst": "worst view",
    "ssim": "SSIM ↑",
    "flip": "FLIP ↓",
    "mean_color_deviation": "color deviation ↓",
}
FORMATS = {name: "{:.3f}" if name in ("ssim", "flip") else "{:.2f}" for name in HEADINGS}
_ROW_NAMES = {CLEAN: "Clean (Ref)", MEAN: "Mean", "ui": "UI elements", "rain": "Rain spots"}
MARKS = "† a run diverged and is left out; (n/m): n of m scenes are there."
NOTE = f"{MARKS} Best of a row and metric in bold."


def row_name(kind: str) -> str:
    """How tables call a category of artifacts."""
    return _ROW_NAMES.get(kind, kind.capitalize())


def densification_names(study: Study) -> str:
    """What the cells of a table hold: ADC / MCMC."""
    return " / ".join(name.upper() for name in study.densifications)


def format_cells(study: Study, kind: str, method: str, metrics: Iterable[str]) -> list[str]:
    """A cell for every metric of one method."""
    return [
        format_pair([format_value(study.value(kind, method, d, metric), metric) for d in study.densifications])
        for metric in metrics
    ]


def format_value(value: Value | None, metric: str, best: str | None = None) -> str:
    """A mean; † where a run diverged, (n/m) where scenes are missing, bold where it is the best."""
    if value is None:
        return "-"
    text = "-" if math.isnan(value.mean) else FORMATS[metric].format(value.mean)
    if text == best:
        text = f"**{text}**"
    if value.scenes + (1 if value.diverged else 0) < value.planned:
        text += f" ({value.scenes}/{value.planned})"
    return text + "†" * bool(value.diverged)


def format_pair(parts: list[str]) -> str:
    """ADC / MCMC, or one dash where there is neither."""
    return "-" if set(parts) == {"-"} else " / ".join(parts)
