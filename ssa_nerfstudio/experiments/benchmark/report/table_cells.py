"""Headings and cells that the tables of a report share."""

from __future__ import annotations

import math

from ssa_nerfstudio.experiments.benchmark.report.study import MEAN, Value
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN

HEADINGS = {
    "psnr": "PSNR ↑",
    "ssim": "SSIM ↑",
    "flip": "FLIP ↓",
    "mean_color_deviation": "color deviation ↓",
}
FORMATS = {"psnr": "{:.2f}", "ssim": "{:.3f}", "flip": "{:.3f}", "mean_color_deviation": "{:.2f}"}
ROW_NAMES = {CLEAN: "Clean (Ref)", MEAN: "Mean", "ui": "UI elements", "rain": "Rain spots"}
NOTE = "† a run diverged and is left out; (n/m): n of m scenes are there. Best of a row and metric in bold."


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
