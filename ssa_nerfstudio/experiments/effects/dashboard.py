"""An opaque car dashboard over the lower part of the frame."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Color
from ssa_nerfstudio.experiments.effects.shapes import coverage


@dataclass(frozen=True, config=STRICT)
class Dashboard:
    """A dashcam's view of the car: padded panel, instrument cluster with two gauges, steering wheel, screen.

    Opaque but for the soft edge (paper, synthetic artifacts: "Dashboard"). Nothing lies above `height`.
    Formation: I = T C + B with T = 1 - A and B = A W, A the matte and W the dashboard's colors.
    """

    height: Annotated[float, Field(gt=0, le=0.5)] = 0.32
    """Fraction of the frame's height covered at the highest point, in (0, 0.5]."""
    softness: Annotated[float, Field(ge=0.5, le=50)] = 1.5
    """Width of the ramp from opaque to absent along the edge, pixels, in [0.5, 50]."""
    panel_color: Color = (64, 60, 58)
    """Padded panel, sRGB, 0..255."""
    cluster_color: Color = (20, 21, 24)
    """Instrument cluster, sRGB, 0..255."""
    dial_color: Color = (214, 218, 222)
    """Rims and ticks of the gauges, sRGB, 0..255."""
    needle_color: Color = (222, 58, 36)
    """Needles of the gauges, sRGB, 0..255."""
    wheel_color: Color = (32, 31, 33)
    """Steering wheel, sRGB, 0..255."""
    screen_color: Color = (46, 92, 128)
    """Screen in the middle of the car, sRGB, 0..255."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """Draw the dashboard; `rng` sets the needles and the grain of the panel."""
        painter = _Painter(height, width, self.height * height)
        x, y = painter.x, painter.y
        # Distances are in the dashboard's height, y upwards from the frame's lower edge, x from its middle.
        driver = -0.2 * painter.aspect
        crest = 0.80 - 0.20 * (x / painter.aspect * 2) ** 2
        hood = 1 - 0.5 * np.abs((x - driver) / 1.15) ** 3.2
        top = np.maximum(crest, hood)

        grain = 1 + 0.05 * rng.standard_normal((height, width))
        painter.fill(self.panel_color)
        painter.shade(grain * (0.62 + 0.65 * np.clip(y / top, 0, 1)))
        # A seam below the upper edge and a lit lip make the panel read as a solid.
        painter.paint(self.dial_color, np.abs(y - top + 0.035) - 0.012, opacity=0.25)
        painter.paint(self.cluster_color, np.abs(y - crest + 0.42) - 0.014, opacity=0.8)

        painter.paint(self.cluster_color, _rounded_box(x - driver, y - 0.43, 1.02, 0.44, 0.3))
        for offset, tilt in zip((-0.47, 0.47), rng.uniform(-0.45, 0.45, 2), strict=True):
            self._paint_gauge(painter, driver + offset, tilt * np.pi)

        right = 0.16 * painter.aspect
        painter.paint(self.cluster_color, _rounded_box(x - right, y - 0.3, 0.52, 0.33, 0.08))
        painter.paint(self.screen_color, _rounded_box(x - right, y - 0.3, 0.45, 0.26, 0.04))
        route = np.abs(y - 0.3 - 0.12 * np.sin(6 * (x - right))) - 0.025
        painter.paint(self.dial_color, np.maximum(route, np.abs(x - right) - 0.42), opacity=0.8)
        vent = _rounded_box(x - 0.37 * painter.aspect, y - 0.34, 0.34, 0.17, 0.06)
        painter.paint(self.cluster_color, np.maximum(vent, 0.03 - np.abs((y - 0.34) % 0.11 - 0.055)))

        radius = np.hypot(x - driver, (y + 1.04) * 0.96)
        painter.paint(self.wheel_color, np.abs(radius - 1.42) - 0.1)
        painter.paint(self.dial_color, np.abs(radius - 1.475) - 0.012, opacity=0.35)

        ramp = self.softness / painter.unit
        return Layers.composited(np.clip((top - y) / ramp, 0, 1), painter.color)

    def _paint_gauge(self, painter: _Painter, center: float, angle: float) -> None:
        """One dial with its rim, ticks and a needle turned by `angle` radians from upright."""
        x, y = painter.x - center, painter.y - 0.5
        radius, turn = np.hypot(x, y), np.arctan2(x, y)
        painter.paint(self.dial_color, np.abs(radius - 0.36) - 0.022)
        step = np.pi / 6
        off_tick = np.abs((turn + step / 2) % step - step / 2) * radius - 0.018
        painter.paint(self.dial_color, np.maximum(off_tick, np.abs(radius - 0.285) - 0.04))
        along, across = x * np.sin(angle) + y * np.cos(angle), x * np.cos(angle) - y * np.sin(angle)
        painter.paint(self.needle_color, np.maximum(np.abs(across) - 0.025, np.abs(along - 0.11) - 0.16))
        painter.paint(self.needle_color, radius - 0.055)


class _Painter:
    """A canvas to paint signed-distance shapes on, anti-aliased over one pixel."""

    def __init__(self, height: int, width: int, unit: float) -> None:
        """A black canvas [height, width, 3] whose unit of length is `unit` pixels."""
        self.unit = unit
        # A frame too narrow for cluster, screen and vent squeezes them.
        self.aspect = max(width / unit, 4.4)
        self.x = ((np.arange(width) + 0.5) / width - 0.5)[None, :] * self.aspect
        self.y = ((height - np.arange(height) - 0.5) / unit)[:, None]
        self.color = np.zeros((height, width, 3))

    def fill(self, color: Color) -> None:
        self.color[:] = np.array(color) / 255

    def shade(self, factor: np.ndarray) -> None:
        self.color = np.clip(self.color * factor[..., None], 0, 1)

    def paint(self, color: Color, distance: np.ndarray, opacity: float = 1.0) -> None:
        """Composite a color where `distance` [height, width], in units, is negative."""
        alpha = opacity * coverage(distance * self.unit)[..., None]
        self.color += alpha * (np.array(color) / 255 - self.color)


def _rounded_box(x: np.ndarray, y: np.ndarray, half_width: float, half_height: float, radius: float) -> np.ndarray:
    """Signed distance to a rectangle with rounded corners, centered at the origin."""
    outside_x, outside_y = np.abs(x) - half_width + radius, np.abs(y) - half_height + radius
    corner = np.hypot(np.maximum(outside_x, 0), np.maximum(outside_y, 0))
    return corner + np.minimum(np.maximum(outside_x, outside_y), 0) - radius
