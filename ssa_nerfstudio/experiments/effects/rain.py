"""Rain drops on the lens, as albumentations' `Spatter` draws them: light is added, none is lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.ranges import require, require_colors
from ssa_nerfstudio.experiments.effects.spatter import draw_spatter


@dataclass(frozen=True)
class Rain:
    """The paper's "Rain spots": `Spatter` in its rain mode, drawn once for all views. A stand-in for real drops.

    Formation: I = clip(C + B), T = 1, B = drops times color. Real drops refract the scene; these only brighten it.

    Raises:
        ValueError: a field is out of its range.
    """

    intensity: float = 0.6
    """Spatter's `intensity`, in (0, 1]: the brightest drop adds 0.9 of it."""
    color: tuple[int, int, int] = (238, 238, 175)
    """Spatter's `color`: of the added light, sRGB, 0..255; its own default, a pale yellow."""
    mean: float = 0.65
    """Spatter's `mean`: of the liquid layer's normal distribution, in [0, 1]; more of it, more drops."""
    deviation: float = 0.3
    """Spatter's `std`: standard deviation of the liquid layer before it is blurred, in [0, 1]."""
    blur: float = 2.0
    """Spatter's `gauss_sigma`: blur of the liquid layer, pixels, in [0.5, 50]; sets the size of the drops."""
    threshold: float = 0.68
    """Spatter's `cutout_threshold`: liquid below this is no drop, in [0, 1]."""

    def __post_init__(self) -> None:
        require(self, intensity="(0, 1]", mean="[0, 1]", deviation="[0, 1]", blur="[0.5, 50]", threshold="[0, 1]")
        require_colors(self, "color")

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """The drops at one frame size.

        Args:
            height: frame height, pixels, at least 1.
            width: frame width, pixels, at least 1.
            rng: seeds the drops.
        """
        drawn = draw_spatter(
            "rain",
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
        return Layers(np.ones((height, width, 3), np.float32), drawn["drops"].astype(np.float32))
