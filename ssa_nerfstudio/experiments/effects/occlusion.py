"""A part of the camera rig in view: near-static, it sways by a few pixels and reflects what is around it."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers, VaryingLayers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Color, Unit
from ssa_nerfstudio.experiments.effects.shapes import clipped_normal, coverage, edge_width, pixel_centers

_MAX_SWAY = 3
"""Largest sway, standard deviations."""
_JOINT_RADIUS = 1.7
"""Radius of the ball joint at the arm's end, in halves of the arm's thickness."""


@dataclass(frozen=True, config=STRICT)
class Occlusion:
    """A stand-in for the paper's real "Occlusion" captures: a mounting arm with a clamp, reaching in from a corner.

    Formation in view i: I = T_i C + B_i with T_i = 1 - A_i and B_i = A_i W_i. A_i is one matte, shifted by a few
    pixels; W_i is the arm's color with highlights whose place, brightness and tint are the view's own.
    """

    corner: Literal["bottom-left", "bottom-right", "top-left", "top-right"] = "bottom-left"
    """Corner of the frame that the arm comes from."""
    reach: Annotated[float, Field(gt=0, le=1.5)] = 0.62
    """Length of the arm in the frame as a fraction of the frame's shorter side, in (0, 1.5]."""
    thickness: Annotated[float, Field(gt=0, le=0.5)] = 0.11
    """Thickness of the arm as a fraction of the frame's shorter side, in (0, 0.5]."""
    blur: Annotated[float, Field(gt=0, le=0.5)] = 0.012
    """Width of the defocused edge as a fraction of the frame's shorter side, in (0, 0.5]."""
    color: Color = (42, 44, 48)
    """The arm where it reflects nothing, sRGB, 0..255."""
    drift: Annotated[float, Field(ge=0, le=50)] = 2.0
    """Standard deviation of the sway along each axis, from view to view, raw pixels, in [0, 50]."""
    reflection: Unit = 0.35
    """Brightness of the strongest highlight, in [0, 1]; each view has between 0.3 and 1 of it."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> VaryingLayers:
        """Draw the arm; `rng` decides its direction."""
        short, down, right = min(height, width), self.corner.startswith("bottom"), self.corner.endswith("right")
        angle, half = rng.uniform(0.6, 0.95), self.thickness * short / 2
        edge, sway = edge_width(self.blur, short), _MAX_SWAY * self.drift
        extent = np.array([np.cos(angle), np.sin(angle)]) * self.reach * short + 3 * half + edge + sway
        columns, rows = np.minimum(np.ceil(extent).astype(int), [width, height])
        box = (
            slice(height - rows, height) if down else slice(0, rows),
            slice(width - columns, width) if right else slice(0, columns),
        )
        # From the corner inwards, pixels.
        x, y = (axis.astype(np.float32) for axis in pixel_centers(rows, columns))
        x, y = x[:, ::-1] if right else x, y[::-1] if down else y
        end, cos, sin = self.reach * short / half, float(np.cos(angle)) / half, float(np.sin(angle)) / half

        def view(rng: np.random.Generator) -> Layers:
            sway_x, sway_y = self.drift * clipped_normal(rng, 2, _MAX_SWAY)
            inward, upward = x - float(sway_x), y - float(sway_y)
            # Along the arm and across it, in halves of its thickness; the joint is the origin.
            u, v = inward * cos + upward * sin - end, upward * cos - inward * sin
            distance = np.minimum(np.maximum(np.abs(v) - 1, u), np.hypot(u, v) - _JOINT_RADIUS)
            matte = coverage(distance * (half / edge))
            covered = matte > 0
            color = np.zeros((*matte.shape, 3), np.float32)
            color[covered] = self._shade(u[covered], v[covered], rng)
            return Layers.composited(matte, color)

        return VaryingLayers(box, view)

    def _shade(self, u: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The arm's color [N, 3] in [0, 1] at places along and across it [N], in the light of one view."""
        place, strength = rng.uniform(-0.55, 0.55), self.reflection * rng.uniform(0.3, 1)
        tint = 1 + 0.2 * rng.uniform(-1, 1, 3)
        radius = np.hypot(u, v)
        on_joint = radius < _JOINT_RADIUS
        # A cylinder and a ball show a bright line or spot where they mirror the light, and are dim at their outlines.
        off_light = np.where(on_joint, np.hypot(u + place, v - place) / _JOINT_RADIUS, np.abs(v - place))
        highlight = strength * np.exp(-((off_light / 0.3) ** 2))
        outline = np.clip(np.where(on_joint, radius / _JOINT_RADIUS, np.abs(v)), 0, 1)
        dimming = 1 - 0.5 * outline**4
        dimming -= 0.35 * (~on_joint & (np.abs(u % 3.2 - 1.6) < 0.12)) + 0.5 * (np.abs(radius - 1.15) < 0.1)
        color = np.array(self.color) / 255 + highlight[:, None] * tint
        return np.clip(color * np.clip(dimming, 0.2, 1)[:, None], 0, 1)
