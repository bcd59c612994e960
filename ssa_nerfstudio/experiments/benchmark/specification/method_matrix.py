"""The rows of the benchmark: what each method sets, for which category of artifact."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

_PAPER = {"overlay": "on", "overlay_start": "statistics", "sparsity": "l1", "ignore_background": False}
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


METHODS: dict[str, Method] = {
    "3dgs": Method("3DGS", {"overlay": "off"}),
    "default": Method("SSA, default", shipped_overlay=True),
    "overlay-on": Method("SSA, default, overlay on", {"overlay": "on"}, shipped_overlay=True),
    "paper": Method("SSA, paper's rule", _PAPER, weight_by_category=True),
    "given": Method("oracle overlay", {"overlay": "given"}),
    "constant-start": Method(
        "SSA, paper's rule, constant start", {**_PAPER, "overlay_start": "constant"}, weight_by_category=True
    ),
    "l1-0": Method("SSA, l1 0", {**_PAPER, "sparsity_weight": 0.0}),
    "l1-0.01": Method("SSA, l1 0.01", {**_PAPER, "sparsity_weight": 0.01}),
    "l1-0.05": Method("SSA, l1 0.05", {**_PAPER, "sparsity_weight": 0.05}),
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
