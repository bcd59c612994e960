"""The runs of a tradeoff as curves of quality over seconds."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from ssa_nerfstudio.experiments.benchmark.report.frontier import Point, frontier
from ssa_nerfstudio.experiments.benchmark.results import Result

BASE = "base"
"""Setting of the run that all others vary."""


@dataclass(frozen=True)
class Curve:
    """One run along its training."""

    result: Result

    @property
    def setting(self) -> str:
        """What it varies, in words."""
        return ", ".join(f"{k} {_shown(v)}" for k, v in self.result.run.variation.items()) or BASE

    @property
    def knobs(self) -> tuple[str, ...]:
        """Names of what it varies."""
        return tuple(self.result.run.variation)

    def value(self, knob: str) -> str:
        """What it sets a knob to, whether it varies it or not."""
        return _shown(self.result.run.value(knob))

    @property
    def points(self) -> list[dict[str, Any]]:
        """Its points with a finite PSNR and more than no seconds, by step."""
        points: list[dict[str, Any]] = [*self.result.curve]
        return [p for p in points if p.get("psnr") is not None and p["seconds"] > 0]


@dataclass(frozen=True)
class Subject:
    """All curves of one scene behind one artifact on one kind of device."""

    scene: str
    effect: str
    device: str
    curves: list[Curve]

    @property
    def name(self) -> str:
        """For files."""
        kind = "cpu" if self.device.startswith("CPU") else "gpu"
        return f"{self.scene}-{self.effect}-{kind}"

    @property
    def alone(self) -> list[Curve]:
        """Those whose seconds count."""
        return [curve for curve in self.curves if curve.result.alone]

    @property
    def knobs(self) -> list[str]:
        """What is varied by itself."""
        return sorted({curve.knobs[0] for curve in self.curves if len(curve.knobs) == 1})

    @property
    def base(self) -> Curve | None:
        """The run that all others vary."""
        return next((curve for curve in self.curves if not curve.knobs), None)

    @property
    def around(self) -> str:
        """What the base sets every knob to; nothing where it is missing."""
        base = self.base
        return "" if base is None else "Base: " + ", ".join(f"{knob} {base.value(knob)}" for knob in self.knobs)

    def front(self, metric: str = "psnr") -> list[Point]:
        """The frontier over all points of the curves that had the device to themselves."""
        sign = -1.0 if metric == "flip" else 1.0
        return frontier([Point(p["seconds"], sign * p[metric]) for c in self.alone for p in c.points if metric in p])

    def whose(self, point: Point) -> tuple[Curve, dict[str, Any]]:
        """The curve, and its entry, that a point of the PSNR frontier is from."""
        return next(
            (c, p) for c in self.alone for p in c.points if (p["seconds"], p["psnr"]) == (point.seconds, point.quality)
        )


def _shown(value: Any) -> str:
    if value is None:
        return "default"
    return value if isinstance(value, str) else json.dumps(value)
