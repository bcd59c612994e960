"""The rows of the benchmark: what each method sets, for which category of artifact."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

_PAPER = {
    "overlay": "on",
    "overlay_start": "statistics",
    "overlay_film": "kept",
    "sparsity": "l1",
    "ignore_background": False,
}
"""The paper's overlay, sparsity weight apart."""


@dataclass(frozen=True)
class Method:
    """One row of the matrix."""

    title: str
    """As tables call it."""
    model: dict[str, Any] = field(default_factory=dict)
    """Settings of the model."""
    shipped_overlay: bool = False
    """Start from the overlay settings that `ssa-splatfacto` ships with, whatever method the benchmark starts from."""
    weight_by_category: bool = False
    """The paper's rule for the sparsity weight."""
    truth: str = ""
    """What it is handed of the artifact: `layers` (T and B) or `area`; where that is not known it is not run."""
    baseline: str = ""
    """Module of `benchmark.baselines` that replaces the overlay; `model` then holds its settings, too."""


METHODS: dict[str, Method] = {
    "3dgs": Method("3DGS", {"overlay": "off"}),
    "default": Method("SSA, default", shipped_overlay=True),
    "overlay-on": Method("SSA, default, overlay on", {"overlay": "on"}, shipped_overlay=True),
    "paper": Method("SSA, paper's rule", _PAPER, weight_by_category=True),
    "given": Method("oracle overlay", {"overlay": "given"}, truth="layers"),
    "constant-start": Method(
        "SSA, paper's rule, constant start", {**_PAPER, "overlay_start": "constant"}, weight_by_category=True
    ),
    "l1-0": Method("SSA, l1 0", {**_PAPER, "sparsity_weight": 0.0}),
    "l1-0.01": Method("SSA, l1 0.01", {**_PAPER, "sparsity_weight": 0.01}),
    "l1-0.05": Method("SSA, l1 0.05", {**_PAPER, "sparsity_weight": 0.05}),
    "robustnerf": Method("RobustNeRF", baseline="robustnerf"),
    "spotless-mlp": Method("SpotLessSplats mlp, hand-made features", {"grouping": "mlp"}, baseline="spotless"),
    "spotless-agg": Method("SpotLessSplats agg, hand-made features", {"grouping": "agg"}, baseline="spotless"),
    "desplat": Method("DeSplat", baseline="desplat"),
    "dc-gaussian": Method("DC-Gaussian (win)", baseline="dc_gaussian"),
    "difix3d": Method("Difix3D+", baseline="difix3d"),
    "flux-kontext": Method("FLUX.1 Kontext, then 3DGS", baseline="flux_kontext"),
    "mask-true": Method("3DGS, true mask", {"mask_from": "truth"}, truth="area", baseline="photo_masks"),
    "mask-detected": Method("3DGS, detected mask", {"mask_from": "detection"}, baseline="photo_masks"),
}
"""Methods by the name that benchmark files use."""
CLEAN = "none"
"""The effect that is none: clean training photos."""


def category(effect: str) -> str:
    """What kind of artifact an effect is: `rain-large-drops` counts as rain."""
    return effect.split("-", 1)[0]


def paper_weight(effect: str, real: bool) -> float:
    """The paper's rule: 0.05, and 0.01 for mud and for real captures."""
    return 0.01 if real or category(effect) == "mud" else 0.05


def title(method: str) -> str:
    """How tables call a method; candidates are called by their names."""
    return METHODS[method].title if method in METHODS else method
