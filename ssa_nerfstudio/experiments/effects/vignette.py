"""Corners darkened by the lens: light is lost, none is added."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Share
from ssa_nerfstudio.experiments.effects.shapes import pixel_centers


@dataclass(frozen=True, config=STRICT)
class Vignette:
    """A radial falloff about the frame's center, the same for all channels.

    Formation: I = T C with T = 1 - strength s^2 (3 - 2 s), s rising from 0 at `start` to 1 in the corners; B = 0.
    """

    strength: Share = 0.75
    """Share of the light lost in the corners, in (0, 1]."""
    start: Annotated[float, Field(ge=0, lt=1)] = 0.25
    """Radius at which the falloff starts, as a fraction of the way from center to corner, in [0, 1)."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """Draw the vignette, which is not random: `rng` is not used."""
        x, y = pixel_centers(height, width)
        radius = np.hypot(x - width / 2, y - height / 2) / np.hypot(width / 2, height / 2)
        s = np.clip((radius - self.start) / (1 - self.start), 0, 1)
        return Layers.dimming(1 - self.strength * s**2 * (3 - 2 * s))
