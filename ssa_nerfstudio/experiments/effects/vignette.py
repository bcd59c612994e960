"""Corners darkened by the lens: light is lost, none is added."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.ranges import require


@dataclass(frozen=True)
class Vignette:
    """A radial falloff about the frame's center, the same for all channels.

    Formation: I = T C with T = 1 - strength s^2 (3 - 2 s), s rising from 0 at `start` to 1 in the corners; B = 0.

    Raises:
        ValueError: a field is out of its range.
    """

    strength: float = 0.75
    """Share of the light lost in the corners, in (0, 1]."""
    start: float = 0.25
    """Radius at which the falloff starts, as a fraction of the way from center to corner, in [0, 1)."""

    def __post_init__(self) -> None:
        require(self, strength="(0, 1]", start="[0, 1)")

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """The vignette at one frame size.

        Args:
            height: frame height, pixels, at least 1.
            width: frame width, pixels, at least 1.
            rng: not drawn from; a vignette has no chance in it.
        """
        y = np.arange(height)[:, None] + 0.5 - height / 2
        x = np.arange(width)[None, :] + 0.5 - width / 2
        radius = np.hypot(x, y) / np.hypot(width / 2, height / 2)
        s = np.clip((radius - self.start) / (1 - self.start), 0, 1)
        return Layers.dimming(1 - self.strength * s**2 * (3 - 2 * s))
