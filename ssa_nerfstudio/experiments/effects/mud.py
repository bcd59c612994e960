"""Mud on the lens, as albumentations' `Spatter` draws it: brown spots, composited."""

from __future__ import annotations

import numpy as np
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Color, Share
from ssa_nerfstudio.experiments.effects.spatter import SpatterEffect


@dataclass(frozen=True, config=STRICT)
class Mud(SpatterEffect):
    """The paper's "Mud": `Spatter` in its mud mode, drawn once for all views. A stand-in for real mud.

    Formation: I = T C + B with T = 1 - A and B = A color: alpha compositing. A channel where the color is black
    also has T = 1 - A.
    """

    intensity: Share = 0.6
    """Spatter's `intensity`: opacity of the densest mud, in (0, 1]."""
    color: Color = (63, 42, 20)
    """Spatter's `color`, sRGB, 0..255. Brown; albumentations' own default, (20, 42, 63), is a blue."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """Draw the mud, which `rng` seeds; as `SpatterEffect._draw`, needs albumentations."""
        drawn = self._draw("mud", height, width, rng)
        return Layers(drawn["non_mud"], drawn["mud"])
