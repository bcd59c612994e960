"""Results of equal length and equal artifacts, looked up and averaged the way the tables need it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ssa_nerfstudio.experiments.benchmark.results import Result
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, METHODS, category

METRICS = ("psnr", "ssim", "flip")
CATEGORY_ORDER = ("watermark", "ui", "dashboard", "rain", "mud", "finger", "occlusion", "vignette", "dust")
MEAN = "mean"
"""Stands for all categories of artifacts."""


@dataclass(frozen=True)
class Value:
    """A mean over scenes of means over seeds."""

    mean: float
    scenes: int
    """Scenes (with their artifacts) that are in it."""
    planned: int
    """Scenes that it should hold, those left out included."""
    diverged: int
    """Runs that diverged and are left out."""


@dataclass
class Study:
    """Runs that differ in scene, artifact, method, densification and seed only."""

    steps: int
    effect_seed: int
    results: list[Result]

    @property
    def title(self) -> str:
        """For headings."""
        return f"{self.steps:,} steps" + (
            f", other artifacts (effect seed {self.effect_seed})" * bool(self.effect_seed)
        )

    @property
    def methods(self) -> list[str]:
        """In the matrix's order, candidates last."""
        present = {result.run.method for result in self.results}
        return [name for name in METHODS if name in present] + sorted(present - METHODS.keys())

    @property
    def categories(self) -> list[str]:
        """Artifacts in the paper's order, clean photos apart."""
        present = {category(result.run.effect) for result in self.results} - {CLEAN}
        return sorted(present, key=lambda name: (_position(name), name))

    @property
    def densifications(self) -> list[str]:
        """adc, mcmc, what is there."""
        return [d for d in ("adc", "mcmc") if any(result.run.densification == d for result in self.results)]

    @property
    def scenes(self) -> list[str]:
        """Names, sorted."""
        return sorted({result.run.scene for result in self.results})

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Every (effect, scene) with an artifact, effects in the paper's order."""
        found = {(r.run.effect, r.run.scene) for r in self.results if r.run.effect != CLEAN}
        return sorted(found, key=lambda pair: (_position(category(pair[0])), pair))

    def select(self, effect: str, scene: str, method: str, densification: str) -> list[Result]:
        """The seeds of one cell, by seed."""
        key = (effect, scene, method, densification)
        chosen = [r for r in self.results if (r.run.effect, r.run.scene, r.run.method, r.run.densification) == key]
        return sorted(chosen, key=lambda r: r.run.seed)

    def value(self, kind: str, method: str, densification: str, metric: str) -> Value | None:
        """Mean of a metric over the scenes of a category (`mean`: of all artifacts; `none`: clean photos).

        None where there is nothing to average.
        """
        pairs = [
            (effect, scene)
            for effect in {r.run.effect for r in self.results}
            for scene in self.scenes
            if (category(effect) == kind or (kind == MEAN and effect != CLEAN))
            and any(r.run.effect == effect and r.run.scene == scene for r in self.results)
        ]
        means, diverged = [], 0
        for effect, scene in sorted(pairs):
            chosen = self.select(effect, scene, method, densification)
            diverged += sum(r.status == "diverged" for r in chosen)
            values = finite(r.metrics.get(metric) for r in chosen if r.status == "finished")
            if values:
                means.append(sum(values) / len(values))
        if not means and not diverged:
            return None
        mean = sum(means) / len(means) if means else float("nan")
        return Value(mean, len(means), len(pairs), diverged)


def studies(results: list[Result]) -> list[Study]:
    """Groups of equal length and equal effect seed; clean photos belong to every effect seed. Longest groups first."""
    usable = [r for r in results if r.status != "failed" and not r.run.marks]
    keys = {(r.run.steps, r.run.effect_seed) for r in usable if r.run.effect != CLEAN and not r.run.real}
    keys |= {(r.run.steps, 0) for r in usable}
    found = []
    for steps, seed in keys:
        chosen = [
            r
            for r in usable
            if r.run.steps == steps and (r.run.effect_seed == seed or r.run.effect == CLEAN or r.run.real)
        ]
        if seed == 0 or any(r.run.effect != CLEAN for r in chosen):
            found.append(Study(steps, seed, chosen))
    return sorted(found, key=lambda study: (-len(study.results), study.steps, study.effect_seed))


def finite(values: Iterable[float | None]) -> list[float]:
    """The values that are numbers; JSON's null stands for infinity."""
    return [value for value in values if value is not None]


def _position(name: str) -> int:
    return CATEGORY_ORDER.index(name) if name in CATEGORY_ORDER else len(CATEGORY_ORDER)
