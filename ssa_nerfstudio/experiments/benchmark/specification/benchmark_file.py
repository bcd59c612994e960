"""What a benchmark file states: scenes, the parts of the matrix in their order, and the knobs of a tradeoff.

All of these raise ValueError where a field is out of its range.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from typing import Any, Literal

from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import METHODS
from ssa_nerfstudio.experiments.configuration import build, locate, read

Densification = Literal["adc", "mcmc"]
DEMO = "demo"
"""The `data` of a scene that stands for the built-in one."""
_MAX_MARKS = 1000
"""More points of a curve cannot be told apart in a figure."""


@dataclass(frozen=True)
class SceneEntry:
    """A capture."""

    data: str
    """Folder of a nerfstudio dataset, $SSA_DATA and other environment variables are expanded; `demo`: built in."""
    name: str | None = None
    """As tables call it: letters, digits, _ and dots; the folder's name where not given."""
    downscale: int = 1
    """Photos are taken from images_N, or reduced by this whole number where there is no such folder."""
    eval_interval: int = 8
    """Every so many photos one tests, where transforms.json states no split."""
    artifact: str | None = None
    """What its training photos carry already (finger, mud, occlusion): then no effect is put in front of them."""
    clean: str | None = None
    """Folder in it with a clean counterpart of every photo, under the same name: what the effect `none` trains on.
    Where no artifact is stated, all effects are put in front of these."""
    mask: str | None = None
    """Picture in it, white where the artifact of a raw photo may be. Scores are taken by it; no training sees it."""
    clean_tests: bool = True
    """False: its test photos carry the artifact, too, and the clean render is compared outside the mask alone."""
    exposure: float = 0.0
    """How much the training photos' exposure varies (`simulation.scene.SceneFile.exposure`); drawn by `effect_seed`."""
    cap_max: int | None = None
    """Largest number of Gaussians under MCMC; the method's own where not given."""
    model: dict[str, Any] = field(default_factory=dict)
    """Settings of the model for this scene."""

    def __post_init__(self) -> None:
        if self.downscale < 1 or self.eval_interval < 2:
            raise ValueError(f"{self.title}: downscale must be at least 1 and eval_interval at least 2")
        if not 0 <= self.exposure <= 1 or (self.exposure and self.artifact):
            raise ValueError(f"{self.title}: exposure must be in [0, 1], and 0 where the photos carry an artifact")
        if not re.fullmatch(r"[A-Za-z0-9_.]*[A-Za-z0-9_][A-Za-z0-9_.]*", self.title):  # "." and ".." are folders
            raise ValueError(f"scene name {self.title!r} must consist of letters, digits, _ and dots; state one: name")
        if self.artifact is None and (self.mask or not self.clean_tests):
            raise ValueError(f"{self.title}: mask and clean_tests are for scenes that state their artifact")
        if not self.clean_tests and self.mask is None:
            raise ValueError(f"{self.title}: without clean test photos, a mask of the artifact is needed")

    @property
    def title(self) -> str:
        """Its name in tables and file names."""
        return self.name or self.data.rstrip("/").rsplit("/", 1)[-1]


@dataclass(frozen=True)
class Part:
    """A product of scenes, effects, methods, densifications and seeds; parts are run in their order."""

    methods: tuple[str, ...]
    """Rows of the matrix (`benchmark.matrix.METHODS`), or candidates of the file."""
    effects: tuple[str, ...] = ("none",)
    """Effects of `ssa simulate`, and `none`: clean photos. Scenes that carry an artifact already have that instead,
    and `none` where they have clean counterparts."""
    scenes: tuple[str, ...] | None = None
    """Names of scenes; all where not given."""
    densification: tuple[Densification, ...] = ("adc",)
    """adc, mcmc."""
    seeds: tuple[int, ...] = (0,)
    """Of the training: order of the views, densification."""
    effect_seed: int = 0
    """Of the effects: where drops fall."""
    steps: int = 7000
    """Training steps; schedules are scaled by steps / 30000."""

    def __post_init__(self) -> None:
        if self.steps < 1 or self.effect_seed < 0 or any(seed < 0 for seed in self.seeds):
            raise ValueError("steps must be at least 1, seeds must not be negative")


@dataclass(frozen=True)
class Tradeoff:
    """What `ssa tradeoff` varies: one knob at a time around a base, and a few together."""

    scenes: tuple[str, ...]
    """Names of scenes of the file."""
    effect: str = "dashboard"
    """What is put in front of them."""
    knobs: dict[str, list[Any]] = field(default_factory=dict)
    """Knob to its settings: steps, image_scale, densification, or any setting of the model."""
    together: tuple[dict[str, Any], ...] = ()
    """Mappings from knob to setting, each one run."""
    base: dict[str, Any] = field(default_factory=dict)
    """Settings that all runs share unless they vary them."""
    steps: int = 7000
    """Steps of the base."""
    seeds: tuple[int, ...] = (0,)
    """Of the training."""
    marks: int = 8
    """Evaluations along each run, from 1 / 16 of its steps to its end, evenly in the logarithm."""

    def __post_init__(self) -> None:
        if self.steps < 1 or self.marks < 1:
            raise ValueError("steps and marks must be at least 1")
        if self.marks > _MAX_MARKS:
            raise ValueError(f"marks must be at most {_MAX_MARKS}, got {self.marks}")
        for name, settings in self.knobs.items():
            if not settings:
                raise ValueError(f"knobs.{name} needs at least one setting")
        if not all(self.together):
            raise ValueError("each of together needs at least one knob")
        single = [{name: setting} for name, settings in self.knobs.items() for setting in settings]
        for settings in (self.base, *single, *self.together):
            _check_knobs(settings)


@dataclass(frozen=True)
class Benchmark:
    """A benchmark file.

    Raises:
        ValueError: a part or tradeoff names something unknown, or two scenes have one name.
    """

    scenes: tuple[SceneEntry, ...]
    """Captures."""
    parts: tuple[Part, ...] = ()
    """The matrix, most important first."""
    method: Literal["ssa-splatfacto", "ssa-splatfacto-paper"] = "ssa-splatfacto"
    """nerfstudio method that every row starts from."""
    protocol: Literal["own", "paper"] = "own"
    """paper: data, splits, resolutions, caps and schedules are the paper's, so that its metrics are comparable."""
    model: dict[str, Any] = field(default_factory=dict)
    """Settings of the model for all runs."""
    candidates: dict[str, dict[str, Any]] = field(default_factory=dict)
    """More methods: name to settings that replace those of a row, `method`; without one the default's, overlay on."""
    tradeoff: Tradeoff | None = None
    """What `ssa tradeoff` does with this file."""
    name: str = ""
    """Of the benchmark; the file's where not given."""

    def __post_init__(self) -> None:
        names = [scene.title for scene in self.scenes]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"scenes need names of their own, and at least one is needed; got {names}")
        for settings in (self.model, *(scene.model for scene in self.scenes)):
            _check_settings(settings, "a setting of the model")
        known = [*METHODS, *self.candidates]
        for name in self.candidates:
            if name in METHODS:
                raise ValueError(f"candidate {name!r} has the name of a method; choose another")
            _check_settings(self.candidates[name], f"a setting of candidate {name!r}")
            _require((self.candidates[name].get("method", "default"),), [*METHODS], "method")
        _check_settings(self.candidates, "a candidate")
        for part in self.parts:
            _require(part.methods, known, "method")
            _require(part.scenes or (), names, "scene")
        if self.tradeoff is not None:
            _require(self.tradeoff.scenes, names, "scene")

    def scene(self, name: str) -> SceneEntry:
        """A capture by name."""
        return next(scene for scene in self.scenes if scene.title == name)


def read_benchmark(name: str) -> Benchmark:
    """A benchmark from a shipped name or a .yaml file.

    Raises:
        InputError: it cannot be found or is faulty.
    """
    path = locate("benchmarks", name)
    values = read(path)
    return build(Benchmark, {"name": path.stem, **values}, str(path))


def _check_knobs(settings: dict[Any, Any]) -> None:
    """Knobs that are no setting of the model, which checks its own."""
    _check_settings(settings, "a knob")
    steps, scale = settings.get("steps", 1), settings.get("image_scale", 1.0)
    if not isinstance(steps, int) or isinstance(steps, bool) or steps < 1:
        raise ValueError(f"steps must be whole numbers from 1 on, got {steps!r}")
    if not isinstance(scale, (int, float)) or isinstance(scale, bool) or not 0 < scale <= 1:
        raise ValueError(f"image_scale must be above 0 and at most 1, got {scale!r}")
    if settings.get("densification", "adc") not in ("adc", "mcmc"):
        raise ValueError(f"densification must be adc or mcmc, got {settings['densification']!r}")


def _check_settings(settings: dict[Any, Any], what: str) -> None:
    for name in settings:
        if not name:
            raise ValueError(f"{what} must have a name, got {name!r}")
        try:
            json.dumps(settings[name], default=str, allow_nan=False)  # as a result states it
        except ValueError as error:
            raise ValueError(f"{what} must be finite, got {name}: {settings[name]}") from error


def _require(names: tuple[str, ...], known: list[str], what: str) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"there is no {what} {name!r}; it has {', '.join(known)}")
