"""From a benchmark to its runs: pure data. A run has everything that decides its outcome, and an id made of it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Benchmark, Part, SceneEntry
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import CLEAN, METHODS, paper_weight

RUN_KNOBS = ("steps", "image_scale", "densification")
"""What a tradeoff can vary beside settings of the model."""
SWITCHES = ("overlay", "overlay_light", "overlay_intervals", "exposure", "sparsity")
"""Settings of the model that can be the word on or off."""
LATER = ("counterparts", "mask", "clean_tests", "baseline", "exposure")
"""Fields that came later: at their defaults they are no part of an id, so that earlier results keep theirs."""


@dataclass(frozen=True)
class Run:
    """One training and its evaluation."""

    scene: str
    """Name of the capture."""
    data: str
    """Its dataset as the benchmark file states it."""
    downscale: int
    eval_interval: int
    effect: str
    """What is in front of the training photos; `none`: nothing."""
    effect_seed: int
    real: bool
    """The photos carry the artifact themselves: nothing is simulated, and no true layers are known."""
    method: str
    """Row of the matrix."""
    densification: str
    """adc or mcmc."""
    seed: int
    steps: int
    nerfstudio_method: str
    """Method whose configuration the run starts from."""
    shipped_overlay: bool
    """Overlay settings are taken from `ssa-splatfacto` before `model` is applied."""
    model: dict[str, Any]
    """Settings of the model by field name."""
    image_scale: float = 1.0
    """Training photos are resized by this; test photos are not."""
    marks: tuple[int, ...] = ()
    """Steps after which the test views are evaluated, besides the end; increasing."""
    variation: dict[str, Any] = field(default_factory=dict)
    """Knobs that a tradeoff set for this run."""
    counterparts: str = ""
    """Folder of the dataset with the clean photos that it trains on, in place of those with the artifact."""
    mask: str = ""
    """File of the dataset: where the artifact of a raw photo may be."""
    clean_tests: bool = True
    """Whether test photos are clean."""
    baseline: str = ""
    """Module of `benchmark.baselines` whose model is trained; empty: the method's own."""
    exposure: float = 0.0
    """How much the training photos' exposure varies."""

    def value(self, knob: str) -> Any:
        """What it sets a tradeoff's knob to, varied or not; None: whatever the method's default is."""
        return getattr(self, knob) if knob in RUN_KNOBS else self.model.get(knob)

    @property
    def id(self) -> str:
        """A name for people and files; equal for equal runs, on every machine."""
        usual = {each.name: each.default for each in dataclasses.fields(self) if each.name in LATER}
        stated = {name: value for name, value in dataclasses.asdict(self).items() if value != usual.get(name, ...)}
        values = json.dumps(stated, sort_keys=True, default=str)
        digest = hashlib.sha256(values.encode()).hexdigest()[:8]
        parts = [self.scene, self.effect, self.method, self.densification, str(self.steps), f"s{self.seed}"]
        return "-".join([*parts, *(f"{k}={v}" for k, v in self.variation.items() if k not in RUN_KNOBS), digest])

    @property
    def training(self) -> str:
        """Equal for runs that differ in nothing but the name of their method: one training answers for all of them."""
        return dataclasses.replace(self, method="").id

    @property
    def dataset(self) -> str:
        """Name of the folder of its prepared dataset; runs that share it train on the same photos."""
        seed = f"-e{self.effect_seed}" if self.effect_seed else ""
        reduced = f"-div{self.downscale}" if self.downscale > 1 else ""
        varied = f"-exposure{self.exposure:g}" if self.exposure else ""
        return f"{self.scene}-{'captured' if self.real else self.effect}{varied}{seed}{reduced}"


def plan(benchmark: Benchmark) -> list[Run]:
    """The runs of all parts in their order, each once.

    Left out are methods that are handed a truth where it is not known: clean photos, real artifacts without a mask.
    """
    runs: dict[str, Run] = {}
    for part in benchmark.parts:
        names = part.scenes or [scene.title for scene in benchmark.scenes]
        for densification, seed, name in product(part.densification, part.seeds, names):
            scene = benchmark.scene(name)
            effects = part.effects if scene.artifact is None else _own_effects(scene, part)
            for effect, method in product(effects, part.methods):
                if not _has_truth(METHODS[_row(benchmark, method)].truth, scene, effect):
                    continue
                run = _run(benchmark, scene, effect, method, densification, part.steps)
                # Nothing decides where nothing is drawn.
                drawn = 0 if (effect == CLEAN and not run.exposure) or run.real else part.effect_seed
                run = dataclasses.replace(run, seed=seed, effect_seed=drawn)
                runs.setdefault(run.id, run)
    return list(runs.values())


def plan_tradeoff(benchmark: Benchmark) -> list[Run]:
    """The base, one knob at a time, and a few together, for every scene and seed of the file's tradeoff, each once.

    Raises:
        ValueError: the file has no tradeoff.
    """
    tradeoff = benchmark.tradeoff
    if tradeoff is None:
        raise ValueError(f"{benchmark.name} states no tradeoff")
    single = [{knob: setting} for knob, settings in tradeoff.knobs.items() for setting in settings]
    runs: dict[str, Run] = {}
    for name in tradeoff.scenes:
        scene = benchmark.scene(name)
        effect = tradeoff.effect if scene.artifact is None else scene.artifact
        for seed in tradeoff.seeds:
            base = _varied(benchmark, scene, effect, seed, {})
            for variation in ({}, *single, *tradeoff.together):
                run = _varied(benchmark, scene, effect, seed, variation)
                # A knob at its base setting is the base once more.
                if dataclasses.replace(run, variation={}) == base:
                    run = base
                runs.setdefault(run.id, run)
    return list(runs.values())


def marks(steps: int, count: int) -> tuple[int, ...]:
    """Steps at which a run is evaluated: `count` of them from steps / 16 to the end, evenly in the logarithm."""
    if count == 1:
        return (steps,)
    return tuple(sorted({max(1, round(steps * 16 ** (k / (count - 1) - 1))) for k in range(count)}))


def _varied(benchmark: Benchmark, scene: SceneEntry, effect: str, seed: int, variation: dict[str, Any]) -> Run:
    """The default method with the base's and the variation's knobs set."""
    tradeoff = benchmark.tradeoff
    assert tradeoff is not None
    knobs = {"steps": tradeoff.steps, "image_scale": 1.0, "densification": "adc", **tradeoff.base, **variation}
    steps, scale, densification = (knobs.pop(name) for name in RUN_KNOBS)
    run = _run(benchmark, scene, effect, "overlay-on", densification, int(steps))
    return dataclasses.replace(
        run,
        seed=seed,
        model=_in_words({**run.model, **knobs}),
        image_scale=float(scale),
        marks=marks(int(steps), tradeoff.marks),
        variation=dict(variation),
    )


def _row(benchmark: Benchmark, method: str) -> str:
    """The row of the matrix that a method, or a candidate of the file, starts from."""
    return method if method in METHODS else benchmark.candidates[method].get("method", "overlay-on")


def _has_truth(truth: str, scene: SceneEntry, effect: str) -> bool:
    """Whether a method can be handed the truth that it needs."""
    known = effect != CLEAN and (scene.artifact is None or (truth == "area" and scene.mask is not None))
    return known or not truth


def _own_effects(scene: SceneEntry, part: Part) -> tuple[str, ...]:
    """The artifact that the scene carries, and none of it where the part asks for that and it can be had."""
    assert scene.artifact is not None
    return (CLEAN, scene.artifact) if scene.clean and CLEAN in part.effects else (scene.artifact,)


def _run(benchmark: Benchmark, scene: SceneEntry, effect: str, method: str, densification: str, steps: int) -> Run:
    real = scene.artifact is not None and effect != CLEAN
    row = METHODS[_row(benchmark, method)]
    model: dict[str, Any] = {**benchmark.model, **scene.model, "strategy": densification, **row.model}
    if scene.cap_max is not None and densification == "mcmc":
        model["cap_max"] = scene.cap_max
    if row.weight_by_category:
        model["sparsity_weight"] = paper_weight(effect, real)
    model |= {name: v for name, v in benchmark.candidates.get(method, {}).items() if name != "method"}
    return Run(
        scene=scene.title,
        data=scene.data,
        downscale=scene.downscale,
        eval_interval=scene.eval_interval,
        effect=effect,
        effect_seed=0,
        real=real,
        method=method,
        densification=densification,
        seed=0,
        steps=steps,
        nerfstudio_method=benchmark.method,
        shipped_overlay=row.shipped_overlay,
        model=_in_words(model),
        counterparts="" if real or scene.clean is None else scene.clean,
        mask=scene.mask or "",
        clean_tests=scene.clean_tests,
        baseline=row.baseline,
        exposure=scene.exposure,
    )


def _in_words(model: dict[str, Any]) -> dict[str, Any]:
    """Settings with the words on and off where they can have those, which YAML reads as booleans."""
    words = {True: "on", False: "off"}
    return {n: words[value] if n in SWITCHES and isinstance(value, bool) else value for n, value in model.items()}
