"""Results of equal length and equal artifacts, looked up and averaged the way the tables need it."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.experiments.benchmark.results import Result
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, METHODS, category

METRICS = ("psnr", "psnr median", "psnr worst", "ssim", "flip")
"""A metric's name alone stands for its mean over the test views."""
OVER_VIEWS = {"median": statistics.median, "worst": min}
"""What else is taken of a run's views; one bad view in sixteen moves a mean by as much as methods differ."""
CATEGORY_ORDER = ("watermark", "ui", "dashboard", "rain", "finger", "mud", "occlusion", "vignette", "dust")
MAX_LOSS = 0.3
"""dB by which the default may be behind the better of paper's rule and oracle."""
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
    clean_tests: bool = True
    """Whether the test photos are clean."""

    @property
    def title(self) -> str:
        """For headings."""
        other = f", other artifacts (effect seed {self.effect_seed})" if self.effect_seed else ""
        marred = "" if self.clean_tests else ", test photos with the artifact"
        return f"{counted(self.steps, 'step')}{other}{marred}"

    @property
    def real(self) -> bool:
        """Whether all photos carry the artifact themselves."""
        return all(result.run.real for result in self.results)

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
    def kinds(self) -> list[str]:
        """The categories, and `mean` where there are several."""
        return [*self.categories, *([MEAN] if len(self.categories) > 1 else [])]

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

    @property
    def subjects(self) -> list[tuple[str, str]]:
        """`pairs`, and every scene without an artifact."""
        return [*self.pairs, *((CLEAN, scene) for scene in self.scenes)]

    def select(self, effect: str, scene: str, method: str, densification: str) -> list[Result]:
        """The seeds of one cell, by seed."""
        key = (effect, scene, method, densification)
        chosen = [r for r in self.results if (r.run.effect, r.run.scene, r.run.method, r.run.densification) == key]
        return sorted(chosen, key=lambda r: r.run.seed)

    def rows(self, results: list[Result]) -> Iterator[tuple[str, str, list[Result]]]:
        """Every method and densification that some of these results have, with those."""
        for key in product(self.methods, self.densifications):
            chosen = [r for r in results if (r.run.method, r.run.densification) == key]
            if chosen:
                yield *key, chosen

    def value(self, kind: str, method: str, densification: str, metric: str) -> Value | None:
        """Mean of a metric over the scenes of a category (`mean`: of all artifacts; `none`: clean photos).

        None where there is nothing to average.
        """
        pairs = sorted({(r.run.effect, r.run.scene) for r in self.results if belongs(r.run.effect, kind)})
        cells = [self.select(*pair, method, densification) for pair in pairs]
        means = finite(mean(chosen, metric) for chosen in cells)
        diverged = sum(r.status == "diverged" for chosen in cells for r in chosen)
        if not means and not diverged:
            return None
        return Value(statistics.mean(means) if means else float("nan"), len(means), len(pairs), diverged)


def studies(results: list[Result]) -> list[Study]:
    """Groups of equal length and equal effect seed; clean photos belong to every effect seed. Longest groups first.

    Captures without clean test photos are groups of their own.
    """
    usable = [r for r in results if r.status != "failed" and not r.run.marks]
    found = []
    for steps, seed, clean_tests in {(r.run.steps, r.run.effect_seed, r.run.clean_tests) for r in usable}:
        alike = [r for r in usable if r.run.steps == steps and r.run.clean_tests == clean_tests]
        chosen = [r for r in alike if r.run.effect_seed == seed or r.run.effect == CLEAN]
        found.append(Study(steps, seed, chosen, clean_tests))
    return sorted(found, key=lambda study: (-len(study.results), study.steps, study.effect_seed))


def finite(values: Iterable[float | None]) -> list[float]:
    """The values that are numbers; JSON's null stands for infinity."""
    return [value for value in values if value is not None]


def finished_values(results: Iterable[Result], metric: str) -> list[float]:
    """A metric of the runs that finished, where it is a number: "psnr", or over the views "psnr worst"."""
    name, _, over = metric.partition(" ")
    finished = [r for r in results if r.status == "finished"]
    if not over:
        return finite(r.metrics.get(name) for r in finished)
    of_views = (finite(view.get(name) for view in r.views.values()) for r in finished)
    return [OVER_VIEWS[over](values) for values in of_views if values]


def mean(results: Sequence[Result], metric: str) -> float | None:
    """Mean of `finished_values`; None where there are none."""
    values = finished_values(results, metric)
    return statistics.mean(values) if values else None


def belongs(effect: str, kind: str) -> bool:
    """Whether an effect is of a category, of which `mean` holds all but clean photos."""
    return category(effect) == kind or (kind == MEAN and effect != CLEAN)


def lead(study: Study, effect: str, scene: str, densification: str) -> float | None:
    """PSNR of the default minus the better of paper's rule and oracle, dB; None where one side was not trained."""
    ours, *references = (
        mean(study.select(effect, scene, method, densification), "psnr") for method in ("default", "paper", "given")
    )
    known = finite(references)
    return None if ours is None or not known else ours - max(known)


def _position(name: str) -> int:
    return CATEGORY_ORDER.index(name) if name in CATEGORY_ORDER else len(CATEGORY_ORDER)
