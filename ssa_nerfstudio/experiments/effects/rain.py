"""Rain drops on the lens, as albumentations' `Spatter` draws them: light is added, none is lost."""

from __future__ import annotations

import numpy as np
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Color, Share
from ssa_nerfstudio.experiments.effects.spatter import SpatterEffect


@dataclass(frozen=True, config=STRICT)
class Rain(SpatterEffect):
    """The paper's "Rain spots": `Spatter` in its rain mode, drawn once for all views. A stand-in for real drops.

    Formation: I = clip(C + B), T = 1, B = drops times color. Real drops refract the scene; these only brighten it.
    """

    intensity: Share = 0.6
    """Spatter's `intensity`, in (0, 1]: the brightest drop adds 0.9 of it."""
    color: Color = (238, 238, 175)
    """Spatter's `color`: of the added light, sRGB, 0..255; its own default, a pale yellow."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """Draw the drops, which `rng` seeds; as `SpatterEffect._draw`, needs albumentations."""
        return Layers(np.ones((height, width, 3), np.float32), self._draw("rain", height, width, rng)["drops"])
