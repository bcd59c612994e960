"""A finger over the edge of the lens: a large, defocused, near-opaque blob whose shading varies from view to view."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers, VaryingLayers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Color, Share, Unit
from ssa_nerfstudio.experiments.effects.shapes import clipped_normal, coverage, edge_width, pixel_centers

_OUTWARD = {"left": (-1, 0), "right": (1, 0), "top": (0, -1), "bottom": (0, 1)}


@dataclass(frozen=True, config=STRICT)
class Finger:
    """A stand-in for the paper's real "Finger" captures: a finger anchored to the frame's edge.

    Formation in view i: I = T C + B_i with T = 1 - A, the same in all views, and B_i = A W_i. The finger's color W_i
    is its skin under light that changes in brightness, tint and direction from view to view.
    """

    side: Literal["left", "right", "top", "bottom"] = "right"
    """Edge of the frame that the finger comes from."""
    position: Unit = 0.7
    """Where along that edge, from left or top, in [0, 1]."""
    reach: Share = 0.42
    """How far the tip reaches into the frame, as a fraction of its shorter side, in (0, 1]."""
    thickness: Share = 0.4
    """Width of the finger as a fraction of the frame's shorter side, in (0, 1]."""
    blur: Annotated[float, Field(gt=0, le=0.5)] = 0.13
    """Width of the defocused edge as a fraction of the frame's shorter side, in (0, 0.5]."""
    opacity: Share = 0.98
    """Opacity inside the edge, in (0, 1]."""
    color: Color = (182, 124, 102)
    """Skin in the mean light, sRGB, 0..255."""
    variation: Annotated[float, Field(ge=0, le=0.5)] = 0.08
    """Standard deviation, from view to view, of the light's brightness relative to its mean, in [0, 0.5]."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> VaryingLayers:
        """Draw the finger; `rng` decides its tilt."""
        short, outward = min(height, width), np.array(_OUTWARD[self.side], float)
        middle = np.array([width, height]) * np.where(outward == 0, self.position, (outward + 1) / 2)
        tilt = rng.uniform(-0.35, 0.35)
        axis = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]]) @ outward
        radius = self.thickness * short / 2

        x, y = pixel_centers(height, width)
        tip = middle - (self.reach * short - radius) * axis
        along = (x - tip[0]) * axis[0] + (y - tip[1]) * axis[1]
        across = (y - tip[1]) * axis[0] - (x - tip[0]) * axis[1]
        # A finger widens a little toward the hand.
        distance = np.hypot(np.minimum(along, 0), across) - radius - 0.12 * np.maximum(along, 0)
        ramp = coverage(distance / edge_width(self.blur, short))
        matte = self.opacity * ramp**2 * (3 - 2 * ramp)

        rows, columns = np.flatnonzero(matte.any(axis=1)), np.flatnonzero(matte.any(axis=0))
        if not len(rows):
            rows = columns = np.zeros(1, int)
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        matte, along, across = matte[box], along[box] / radius, np.clip(across[box] / radius, -1.5, 1.5)
        # Blood lets red light through where the finger is thin, and the nail's end is paler.
        thinness = np.clip(1.1 + distance[box] / radius, 0, 1)[..., None] ** 2
        skin = (np.array(self.color) / 255 * (1 + thinness * [0.3, 0.1, 0.06])).astype(np.float32)
        body = (1 - 0.28 * across**2 - 0.06 * np.clip(along, 0, 3)).astype(np.float32)
        across, along = across.astype(np.float32), np.clip(along, -1, 2).astype(np.float32)

        def view(rng: np.random.Generator) -> Layers:
            gain, slope_across, slope_along, *tint = (self.variation * clipped_normal(rng, 6, 2.5)).tolist()
            light = body + slope_across * across + 0.5 * slope_along * along
            color = light[..., None] * skin * ((1 + gain) * (1 + 0.3 * np.array(tint, np.float32)))
            return Layers.composited(matte, np.clip(color, 0, 1))

        return VaryingLayers(box, view)
