"""Dust on the sensor: defocused dark specks and a few fibres; light is lost, none is added."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Share
from ssa_nerfstudio.experiments.effects.shapes import coverage, edge_width

_SUBPIXEL_BITS = 4


@dataclass(frozen=True, config=STRICT)
class Dust:
    """Specks and fibres scattered over the frame, each dimming what is behind it.

    Formation: I = T C, T the product over particles of 1 - opacity times coverage, the same for all channels; B = 0.
    """

    specks: Annotated[int, Field(ge=0, le=10_000)] = 60
    """Number of specks, in [0, 10000]."""
    fibres: Annotated[int, Field(ge=0, le=1_000)] = 6
    """Number of fibres, in [0, 1000]."""
    radius: Annotated[float, Field(gt=0, le=0.2)] = 0.012
    """Radius of the largest specks as a fraction of the frame's diagonal, in (0, 0.2]; the smallest have a fifth."""
    opacity: Share = 0.75
    """Share of the light that the densest particle takes, in (0, 1]; the thinnest takes 0.4 of that."""
    softness: Share = 0.6
    """Width of a speck's edge as a fraction of its radius, in (0, 1]."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """Draw the dust; `rng` decides places, sizes and densities of the particles."""
        transmittance = np.ones((height, width))
        largest = self.radius * np.hypot(height, width)
        for _ in range(self.specks):
            self._add_speck(transmittance, largest * 5 ** -rng.uniform(0, 1), rng)
        for _ in range(self.fibres):
            transmittance *= 1 - self._fibre(height, width, largest, rng)
        return Layers.dimming(transmittance)

    def _density(self, rng: np.random.Generator) -> float:
        return self.opacity * rng.uniform(0.4, 1)

    def _add_speck(self, transmittance: np.ndarray, radius: float, rng: np.random.Generator) -> None:
        """Multiply one speck into T [H, W]."""
        height, width = transmittance.shape
        center_x, center_y, density = rng.uniform(0, width), rng.uniform(0, height), self._density(rng)
        squeeze, turn = rng.uniform(0.7, 1), rng.uniform(0, np.pi)
        reach = 2 * radius + 1
        rows = slice(max(0, int(center_y - reach)), min(height, int(center_y + reach) + 1))
        columns = slice(max(0, int(center_x - reach)), min(width, int(center_x + reach) + 1))
        y = np.arange(rows.start, rows.stop)[:, None] + 0.5 - center_y
        x = np.arange(columns.start, columns.stop)[None, :] + 0.5 - center_x
        along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
        distance = np.hypot(along, across / squeeze) - radius
        edge = edge_width(self.softness, radius)
        transmittance[rows, columns] *= 1 - density * coverage(distance / edge)

    def _fibre(self, height: int, width: int, largest: float, rng: np.random.Generator) -> np.ndarray:
        """Share of the light that one fibre takes, [H, W] in [0, 1]: a blurred curve."""
        start, length = rng.uniform(0, [width, height]), largest * rng.uniform(6, 14)
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0.06, 0.1, 24))
        steps = length / 24 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        points = np.rint((start + np.cumsum(steps, axis=0)) * 2**_SUBPIXEL_BITS).astype(np.int32)
        curve = np.zeros((height, width), np.uint8)
        thickness = max(1, round(largest / 5))
        cv2.polylines(curve, [points], False, (255,), thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
        blurred = cv2.GaussianBlur(curve.astype(np.float64) / 255, (0, 0), max(0.6, largest / 10))
        return self._density(rng) * np.clip(blurred, 0, 1)
