"""A semi-transparent watermark: a camera logo at the frame's center and a line of text beneath it."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from pydantic import Field
from pydantic.dataclasses import dataclass

from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.parameters import STRICT, Color, Share

_OVERSAMPLING = 4


@dataclass(frozen=True, config=STRICT)
class Watermark:
    """Stock footage's watermark, composited at one opacity over every frame (paper, synthetic artifacts).

    Formation: I = T C + B with T = 1 - A and B = A color, A = alpha times the mark's coverage of the pixel.
    """

    alpha: Share = 0.4
    """Opacity of the mark, in (0, 1]; the paper uses 0.4."""
    size: Share = 0.62
    """Width of the text line as a fraction of the frame's width, in (0, 1]; smaller where a flat frame needs it."""
    color: Color = (255, 255, 255)
    """Color of the mark, sRGB, 0..255."""
    text: Annotated[str, Field(pattern=r"\S")] = "SAMPLE STOCK"
    """The line beneath the logo; not empty."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """Draw the watermark, which is not random: `rng` is not used."""
        return Layers.composited(self.alpha * self._coverage(height, width), np.array(self.color) / 255)

    def _coverage(self, height: int, width: int) -> np.ndarray:
        """Share of each pixel under the mark, [height, width] in [0, 1]."""
        canvas = Image.new("L", (width * _OVERSAMPLING, height * _OVERSAMPLING))
        draw = ImageDraw.Draw(canvas)
        center_x, center_y = canvas.width / 2, canvas.height / 2
        # Logo and text together are 0.8 of the text's width high, measured about the center.
        extent = min(self.size * canvas.width, 1.2 * canvas.height)

        def box(half_width: float, top: float, bottom: float) -> tuple[float, float, float, float]:
            return (
                center_x - half_width * extent,
                center_y + top * extent,
                center_x + half_width * extent,
                center_y + bottom * extent,
            )

        draw.rounded_rectangle(box(0.1, -0.215, -0.1), radius=0.03 * extent, fill=255)
        draw.rounded_rectangle(box(0.235, -0.165, 0.165), radius=0.05 * extent, fill=255)
        draw.ellipse(box(0.125, -0.125, 0.125), fill=0)
        draw.ellipse(box(0.085, -0.085, 0.085), fill=255)

        reference = ImageFont.load_default(100).getlength(self.text)
        font = ImageFont.load_default(max(1.0, 100 * extent / reference))
        draw.text((center_x, center_y + 0.28 * extent), self.text, fill=255, font=font, anchor="mm")
        return np.asarray(canvas.reduce(_OVERSAMPLING), dtype=np.float64) / 255
