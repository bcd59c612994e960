"""A scene: effects, their parameters and a seed, from which the artifact of a frame size is drawn."""

from __future__ import annotations

import dataclasses
import json
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.configuration import build, locate, read
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS, Effect, effect_class
from ssa_nerfstudio.experiments.effects.composition import Composition
from ssa_nerfstudio.experiments.effects.layers import VaryingLayers

MAX_EXPOSURE = 1.0
"""Largest deviation of the photos' exposure: a factor of 2.7 in displayed values."""


@dataclass(frozen=True)
class SceneFile:
    """A scene as its YAML file states it."""

    effects: list[Any]
    """From the scene outwards; each a name, a .yaml file, or keys and values: `effect` and that effect's parameters."""
    seed: int = 0
    """Decides everything random; not negative."""
    exposure: float = 0.0
    """Standard deviation of the logarithm of the photos' gains; 0: all photos have one exposure."""
    provenance: dict = field(default_factory=dict)
    """Written by `ssa simulate`; not read."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"SceneFile.seed must not be negative, got {self.seed}")
        if not 0 <= self.exposure <= MAX_EXPOSURE:
            raise ValueError(f"SceneFile.exposure must be in [0, {MAX_EXPOSURE}], got {self.exposure}")


@dataclass(frozen=True)
class Scene:
    """Effects in front of one another, the last nearest to the camera, and their seed."""

    effects: tuple[tuple[str, Effect], ...]
    """Name and parameters of each effect."""
    seed: int = 0
    """Not negative."""
    exposure: float = 0.0
    """See `SceneFile.exposure`."""

    def draw(self, height: int, width: int) -> Composition:
        """Draw the artifact at one frame size, pixels; there must be effects."""
        return Composition(
            [
                effect.layers(height, width, np.random.default_rng([self.seed, *stream]))
                for stream, (_, effect) in zip(self._streams(), self.effects, strict=True)
            ]
        )

    def view_generators(self, artifact: Composition, view: int) -> list[np.random.Generator]:
        """Return the generators of one view, one for each effect that varies.

        Args:
            artifact: result of `draw`.
            view: number of the view in the dataset's sorted order.
        """
        return [
            np.random.default_rng([self.seed, *stream, 1 + view])
            for stream, part in zip(self._streams(), artifact.parts, strict=True)
            if isinstance(part, VaryingLayers)
        ]

    def describe(self) -> list[dict[str, Any]]:
        """Return each effect with all its parameters, as a scene file states them."""
        return [
            # YAML has lists, but no tuples.
            json.loads(json.dumps({"effect": name, **dataclasses.asdict(effect)}))  # type: ignore[call-overload]
            for name, effect in self.effects
        ]

    def _streams(self) -> list[tuple[int, int]]:
        # The draw of an effect does not depend on the others; an effect named twice is drawn differently.
        names = [name for name, _ in self.effects]
        return [(zlib.crc32(name.encode()), names[:number].count(name)) for number, name in enumerate(names)]


def read_effects(names: tuple[str, ...], stated_in: str = "") -> tuple[tuple[str, Effect], ...]:
    """Read effects from shipped names or .yaml files.

    Args:
        names: names, or paths of .yaml files.
        stated_in: file and key that name them, for messages.

    Raises:
        InputError: one cannot be found or is faulty.
    """
    effects = []
    for name in names:
        path = locate("effects", name, stated_in)
        effects.append(_effect(read(path), str(path)))
    return tuple(effects)


def read_scene(name: str) -> Scene:
    """Read a scene from a shipped name or a .yaml file.

    Raises:
        InputError: it cannot be found, or it or an effect that it names is faulty.
    """
    path = locate("scenes", name)
    stated = build(SceneFile, read(path), str(path))
    effects: list[tuple[str, Effect]] = []
    for number, item in enumerate(stated.effects):
        if isinstance(item, str):
            effects += read_effects((item,), f"{path}: effects[{number}]")
        else:
            effects.append(_effect(item, f"{path}: effects[{number}]"))
    return Scene(tuple(effects), stated.seed, stated.exposure)


def _effect(values: Any, where: str) -> tuple[str, Effect]:
    if not isinstance(values, dict) or "effect" not in values:
        raise InputError(f"{where}: key 'effect' is missing", f"it names one of {', '.join(EFFECTS)}")
    name = values["effect"]
    if not isinstance(name, str) or name not in EFFECTS:
        raise InputError(f"{where}: effect {name!r} is unknown", f"choose one of {', '.join(EFFECTS)}")
    parameters = {key: value for key, value in values.items() if key != "effect"}
    return name, build(effect_class(name), parameters, where)
