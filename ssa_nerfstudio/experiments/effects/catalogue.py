"""The effects by name; a module is imported when its effect is asked for and not before."""

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
"""Name of each effect, which is also its module's, and its class."""


class Effect(Protocol):
    """A frozen dataclass of parameters that draws an artifact for any frame."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers | VaryingLayers:
        """The artifact at one frame size, pixels; `rng` decides all that chance decides."""
        ...


def effect_class(name: str) -> type[Effect]:
    """The class of an effect.

    Raises:
        KeyError: there is no such effect.
    """
    return getattr(importlib.import_module(f"ssa_nerfstudio.experiments.effects.{name}"), EFFECTS[name])
