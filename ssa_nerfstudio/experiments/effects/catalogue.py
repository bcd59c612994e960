"""The effects by name; the module of an effect is imported with its first use."""

from __future__ import annotations

import importlib
from typing import Protocol

import numpy as np

from ssa_nerfstudio.experiments.effects.layers import Layers, VaryingLayers

EFFECTS = {
    "watermark": "Watermark",
    "ui": "UI",
    "dashboard": "Dashboard",
    "rain": "Rain",
    "mud": "Mud",
    "finger": "Finger",
    "occlusion": "Occlusion",
    "vignette": "Vignette",
    "dust": "Dust",
}
"""Class of each effect by its name, which is also its module's."""


class Effect(Protocol):
    """A frozen pydantic dataclass of parameters, which raises ValueError for values out of range."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers | VaryingLayers:
        """Draw the artifact at one frame size.

        Args:
            height, width: of the frame, pixels, at least 1.
            rng: decides everything random.

        Raises:
            InputError: the effect needs a package that is not installed.
        """
        ...


def effect_class(name: str) -> type[Effect]:
    """Return the class of an effect.

    Raises:
        KeyError: there is no such effect.
    """
    return getattr(importlib.import_module(f"ssa_nerfstudio.experiments.effects.{name}"), EFFECTS[name])
