"""Mud on the lens, as albumentations' `Spatter` draws it: brown spots, composited."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.ranges import require, require_colors
from ssa_nerfstudio.experiments.effects.spatter import draw_spatter


@dataclass(frozen=True)
class Mud:
    """The paper's "Mud": `Spatter` in its mud mode, drawn once for all views. A stand-in for real mud.

    Formation: I = T C + B with T = 1 - A and B = A color: alpha compositing. A channel where the color is black
    also has T = 1 - A.

    Raises:
        ValueError: a field is out of its range.
    """

    intensity: float = 0.6
    """Spatter's `intensity`: opacity of the densest mud, in (0, 1]."""
    color: tuple[int, int, int] = (63, 42, 20)
    """Spatter's `color`, sRGB, 0..255. Brown; albumentations' own default, (20, 42, 63), is a blue."""
    mean: float = 0.65
    """Spatter's `mean`: of the liquid layer's normal distribution, in [0, 1]; more of it, more mud."""
    deviation: float = 0.3
    """Spatter's `std`: standard deviation of the liquid layer before it is blurred, in [0, 1]."""
    blur: float = 2.0
    """Spatter's `gauss_sigma`: blur of the liquid layer, pixels, in [0.5, 50]; sets the size of the spots."""
    threshold: float = 0.68
    """Spatter's `cutout_threshold`: liquid below this is no mud, in [0, 1]."""

    def __post_init__(self) -> None:
        require(self, intensity="(0, 1]", mean="[0, 1]", deviation="[0, 1]", blur="[0.5, 50]", threshold="[0, 1]")
        require_colors(self, "color")

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """The mud at one frame size.

        Args:
            height: frame height, pixels, at least 1.
            width: frame width, pixels, at least 1.
            rng: seeds the mud.
        """
        drawn = draw_spatter(
            "mud",
            height,
            width,
            rng,
            color=self.color,
            intensity=self.intensity,
            mean=self.mean,
            deviation=self.deviation,
            blur=self.blur,
            threshold=self.threshold,
        )
        return Layers(drawn["non_mud"].astype(np.float32), drawn["mud"].astype(np.float32))
