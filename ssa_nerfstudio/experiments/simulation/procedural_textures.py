"""Textures of the built-in scene: patterns under noise, with detail at every scale for edges and features."""

from __future__ import annotations

import numpy as np
from PIL import Image

TEXELS_PER_UNIT = 96
"""Resolution, texels per scene unit."""


def draw_texture(kind: int, half: tuple[float, float], colors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw one of six patterns between a dark and a light color, under several octaves of value noise.

    Args:
        kind: number of the pattern, from 0.
        half: half the width and half the height, scene units.
        colors: the dark and the light color, [2, 3] in [0, 1].
        rng: decides the noise, the pattern's period and the tones of its cells.

    Returns:
        Colors [rows along v, columns along u, 3], about [0, 1].
    """
    width, height = (round(2 * side * TEXELS_PER_UNIT) for side in half)
    period = 0.3 * np.sqrt(max(half)) * rng.uniform(0.8, 1.2)
    y, x = np.mgrid[:height, :width].astype(np.float32) / np.float32(TEXELS_PER_UNIT * period)
    noise = np.zeros((height, width), dtype=np.float32)
    for octave in range(5):
        cell = 64 >> octave
        lattice = Image.fromarray(rng.uniform(-1, 1, (height // cell + 2, width // cell + 2)).astype(np.float32))
        smooth = lattice.resize((lattice.width * cell, lattice.height * cell), Image.Resampling.BICUBIC)
        noise += 0.75**octave * np.asarray(smooth)[:height, :width]
    row = np.floor(y)
    if kind == 0:  # bricks
        x = x / 2 + row / 2
        mask = (x % 1 > 0.06) & (y % 1 > 0.12)
    elif kind == 1:  # diagonal stripes
        x = x + 0.5 * y
        mask = x % 1 > 0.5
    elif kind == 2:  # dots
        mask = np.hypot(x % 1 - 0.5, y % 1 - 0.5) < 0.34
    elif kind == 3:  # planks
        mask = x % 1 > 0.08
    elif kind == 4:  # checkers
        mask = (np.floor(x) + row) % 2 > 0
    else:  # contour lines
        mask = np.sin(9 * noise) > 0
    tone = rng.uniform(-0.25, 0.25, (64, 64)).astype(np.float32)[row.astype(int) % 64, np.floor(x).astype(int) % 64]
    blend = np.clip(np.where(mask, 0.8, 0.1) + tone + 0.24 * noise, 0, 1)[..., None]
    return ((1 - blend) * colors[0] + blend * colors[1]) * rng.uniform(0.94, 1.06, 3)
