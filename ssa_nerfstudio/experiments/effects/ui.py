"""A game's or screen recorder's interface: panels, bars, buttons, a minimap and text along the frame's edges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from pydantic import Field
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Color, Share

_FINE = 4
"""Oversampling in frames of up to a megapixel, half of it in larger ones."""


@dataclass(frozen=True, config=STRICT)
class UI:
    """The paper's "UI Elements": buttons and HUD elements on the periphery, the middle of the frame left free.

    Formation: I = T C + B with T = 1 - A and B = A W, both in steps of 1 / 255: panels are translucent, what is drawn
    on them is opaque.
    """

    scale: Annotated[float, Field(ge=0.2, le=1)] = 1.0
    """Size of all elements, in [0.2, 1]; at 1 a button's side is 0.1 of the frame's height or 1 / 13 of its width."""
    panel_alpha: Share = 0.65
    """Opacity of panels and empty buttons, in (0, 1]."""
    panel_color: Color = (18, 22, 30)
    """Panels, sRGB, 0..255."""
    accent_color: Color = (255, 186, 52)
    """Icons, frames and the marker of the minimap, sRGB, 0..255."""
    text_color: Color = (240, 244, 248)
    """Text, sRGB, 0..255."""
    title: str = "LEVEL 07"
    """The line at the upper edge; may be empty."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """Draw the interface; `rng` decides the fill of the bars, the score, and the minimap's roads."""
        fine = _FINE if height * width <= 2**20 else _FINE // 2
        painter = _Painter(height * fine, width * fine, self)
        painter.status(rng.uniform(0.35, 0.95, 3))
        painter.title(self.title, int(rng.integers(10_000, 1_000_000)))
        painter.minimap(rng)
        painter.actions()
        painter.menu()
        # Pixels are averaged premultiplied: RGBa is Pillow's name for that.
        pixels = np.asarray(painter.canvas.convert("RGBa").reduce(fine), dtype=np.float32) / 255
        return Layers(np.repeat(1 - pixels[..., 3:], 3, axis=2), np.ascontiguousarray(pixels[..., :3]))


class _Painter:
    """Draws the elements on an RGBA canvas; a later shape replaces what is below it, opacity included."""

    def __init__(self, height: int, width: int, style: UI) -> None:
        """An empty canvas; lengths are in units of an action button's side."""
        self.canvas = Image.new("RGBA", (width, height))
        self._draw = ImageDraw.Draw(self.canvas)
        # The lower edge holds 13 units side by side.
        self._unit = style.scale * min(height / 10, width / 13)
        self._right, self._bottom = width / self._unit, height / self._unit
        self._panel = (*style.panel_color, round(255 * style.panel_alpha))
        self._accent, self._text_color = (*style.accent_color, 255), (*style.text_color, 255)

    def status(self, levels: np.ndarray) -> None:
        """Upper left: a portrait and three bars, filled to `levels` [3] in [0, 1]."""
        self._box(0.25, 0.25, 4.6, 1.75, self._panel)
        self._circle(1.0, 1.0, 0.62, self._accent)
        self._circle(1.0, 1.0, 0.54, (52, 60, 74, 255))
        self._circle(1.0, 0.85, 0.2, self._text_color)
        self._draw.pieslice(self._scaled(0.64, 1.08, 1.36, 1.8), 180, 360, fill=self._text_color)
        colors = ((208, 52, 48, 255), (56, 132, 220, 255), (92, 184, 84, 255))
        for row, (level, color) in enumerate(zip(levels, colors, strict=True)):
            top = 0.5 + 0.38 * row
            self._box(1.8, top, 4.4, top + 0.26, (10, 12, 16, 255), 0.08)
            self._box(1.84, top + 0.04, 1.84 + 2.52 * level, top + 0.22, color, 0.06)

    def title(self, title: str, score: int) -> None:
        """Top: a line of text and a score beneath it."""
        middle = self._right / 2
        self._text(middle, 0.6, 0.5, title, self._text_color)
        self._text(middle, 1.15, 0.34, f"{score:07d}", self._accent)

    def minimap(self, rng: np.random.Generator) -> None:
        """Upper right: a round map with three roads and an arrow."""
        x, y, radius = self._right - 1.5, 1.5, 1.25
        self._circle(x, y, radius, self._accent)
        self._circle(x, y, radius - 0.07, (46, 66, 58, 255))
        for turn in rng.uniform(0, np.pi) + np.array([0, 0.9, 2.1]):
            offset, along = rng.uniform(-0.5, 0.5), np.array([np.cos(turn), np.sin(turn)])
            middle = np.array([x, y]) + offset * np.array([-along[1], along[0]])
            half = np.sqrt((radius - 0.09) ** 2 - offset**2) - 0.06
            ends = np.concatenate([middle - half * along, middle + half * along]) * self._unit
            self._draw.line(ends.tolist(), fill=(150, 152, 140, 255), width=max(1, round(0.13 * self._unit)))
        self._polygon(x, y, ((0, -0.3), (0.2, 0.22), (0, 0.1), (-0.2, 0.22)))

    def actions(self) -> None:
        """Bottom: five buttons with icons and their keys, the second one selected."""
        top, left = self._bottom - 1.35, self._right / 2 - 2.95
        for number in range(5):
            x = left + 1.2 * number
            frame = self._accent if number == 1 else (120, 128, 140, 255)
            self._box(x - 0.06, top - 0.06, x + 1.06, top + 1.06, frame, 0.18)
            self._box(x, top, x + 1, top + 1, self._panel, 0.14)
            self._icon(number, x + 0.5, top + 0.5)
            self._text(x + 0.17, top + 0.2, 0.24, str(number + 1), self._text_color)

    def menu(self) -> None:
        """Lower left: a recording mark and its time. Lower right: two round buttons."""
        self._box(0.25, self._bottom - 0.95, 2.95, self._bottom - 0.35, self._panel)
        self._circle(0.6, self._bottom - 0.65, 0.14, (228, 44, 40, 255))
        self._text(1.85, self._bottom - 0.65, 0.34, "REC 12:47", self._text_color)
        buttons = ((0.85, 2.0, "A", (60, 160, 84, 255)), (2.0, 0.9, "B", (196, 60, 52, 255)))
        for from_right, from_bottom, letter, color in buttons:
            x, y = self._right - from_right, self._bottom - from_bottom
            self._circle(x, y, 0.55, self._text_color)
            self._circle(x, y, 0.48, color)
            self._text(x, y, 0.55, letter, self._text_color)

    def _icon(self, kind: int, x: float, y: float) -> None:
        """One of five pictograms about a point: sword, flask, lightning, shield, plus."""
        if kind == 1:
            self._circle(x, y + 0.1, 0.22, (96, 176, 232, 255))
            self._box(x - 0.07, y - 0.3, x + 0.07, y - 0.05, self._text_color, 0.02)
            return
        outlines = {
            0: [(-0.28, 0.22), (0.2, -0.3), (0.28, -0.28), (0.26, -0.2), (-0.22, 0.28)],
            2: [(0.08, -0.32), (-0.2, 0.06), (-0.02, 0.06), (-0.1, 0.32), (0.2, -0.08), (0.02, -0.08)],
            3: [(0, -0.3), (0.25, -0.2), (0.22, 0.1), (0, 0.32), (-0.22, 0.1), (-0.25, -0.2)],
            4: [(-0.09, -0.28), (0.09, -0.28), (0.09, 0.28), (-0.09, 0.28)],
        }
        self._polygon(x, y, outlines[kind])
        if kind == 4:
            self._box(x - 0.28, y - 0.09, x + 0.28, y + 0.09, self._accent, 0)

    def _polygon(self, x: float, y: float, outline: Sequence[tuple[float, float]]) -> None:
        points = [((x + dx) * self._unit, (y + dy) * self._unit) for dx, dy in outline]
        self._draw.polygon(points, fill=self._accent)

    def _scaled(self, *box: float) -> list[float]:
        return [side * self._unit for side in box]

    def _circle(self, x: float, y: float, radius: float, fill: tuple[int, ...]) -> None:
        self._draw.ellipse(self._scaled(x - radius, y - radius, x + radius, y + radius), fill=fill)

    def _box(self, left: float, top: float, right: float, bottom: float, fill: tuple[int, ...], r: float = 0.2) -> None:
        self._draw.rounded_rectangle(self._scaled(left, top, right, bottom), radius=r * self._unit, fill=fill)

    def _text(self, x: float, y: float, size: float, text: str, fill: tuple[int, ...]) -> None:
        font = ImageFont.load_default(max(1.0, size * self._unit))
        outline = round(0.07 * size * self._unit)
        self._draw.text(
            (x * self._unit, y * self._unit),
            text,
            fill=fill,
            font=font,
            anchor="mm",
            stroke_width=outline,
            stroke_fill=(10, 12, 16, 255),
        )
