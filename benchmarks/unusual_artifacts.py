"""Artifacts that no effect draws: `python benchmarks/unusual_artifacts.py --data DIR --output DIR`

Plain bars, fades, soft shapes, films and lines, for a look at a start that was made with others in mind:
`python benchmarks/start_accuracy.py --data OUTPUT/*`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.layers import Layers

Shape = Callable[[int, int, np.random.Generator], Layers]
SHAPES: dict[str, Shape] = {}
"""By name: from height and width, pixels, and a generator."""


@dataclass(frozen=True)
class Drawn:
    """A shape as an effect of the simulator."""

    shape: str
    """One of SHAPES."""

    def layers(self, height: int, width: int, rng: np.random.Generator) -> Layers:
        """Draw it."""
        return SHAPES[self.shape](height, width, rng)


@dataclass
class Command:
    """Write a dataset behind each shape, its training photos with the shape and its test photos clean."""

    data: Path
    """A nerfstudio dataset without an artifact."""
    output: Path
    """Folder for the datasets: the name of DATA, a hyphen and the shape's. Those that exist are left as they are."""
    shapes: tuple[str, ...] = field(default_factory=lambda: tuple(SHAPES))
    """Some of them only."""

    def run(self) -> None:
        """Draw shape after shape.

        Raises:
            InputError: a shape is unknown, or the dataset cannot be used.
        """
        from ssa_nerfstudio.data.dataset import Dataset
        from ssa_nerfstudio.experiments.simulation.scene import Scene
        from ssa_nerfstudio.experiments.simulation.simulator import simulate

        if unknown := [name for name in self.shapes if name not in SHAPES]:
            raise InputError(f"there is no shape {unknown[0]!r}", f"choose some of {', '.join(SHAPES)}")
        dataset = Dataset.read(self.data, 8, 1)
        self.output.mkdir(parents=True, exist_ok=True)
        for name in self.shapes:
            folder = self.output / f"{dataset.root.resolve().name}-{name}"
            if not folder.exists():
                simulate(dataset, Scene(((name, Drawn(name)),)), folder, 2)
            print(folder)


def _shape(draw: Shape) -> Shape:
    SHAPES[draw.__name__.replace("_", "-")] = draw
    return draw


def _places(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the pixels in [0, 1], float32 [H, W]."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return (x + 0.5) / width, (y + 0.5) / height


def _hiding(matte: np.ndarray, color: object) -> Layers:
    return Layers.composited(matte.clip(0, 1), np.asarray(color, np.float32))


def _soft(matte: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(matte.astype(np.float32), (0, 0), sigma)


def _text(height: int, width: int, text: str, place: tuple[float, float], scale: float, stroke: float) -> np.ndarray:
    """Matte of a line of text whose capitals are about 22 `scale` of 300 parts of the frame high."""
    matte, unit = np.zeros((height, width), np.float32), min(height, width) / 300
    at = int(place[0] * width), int(place[1] * height)
    stroke_width = max(1, round(stroke * unit))
    cv2.putText(matte, text, at, cv2.FONT_HERSHEY_DUPLEX, scale * unit, 1.0, stroke_width, cv2.LINE_AA)
    return matte


@_shape
def letterbox(height: int, width: int, rng: np.random.Generator) -> Layers:
    _, y = _places(height, width)
    return _hiding((abs(y - 0.5) > 0.38).astype(float), (0, 0, 0))


@_shape
def side_bars(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, _ = _places(height, width)
    return _hiding((abs(x - 0.5) > 0.35).astype(float), (0.06, 0.06, 0.07))


@_shape
def black_circle(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, y = _places(height, width)
    return _hiding((2 * np.hypot(x - 0.5, y - 0.5) - 1.02) / 0.02, (0, 0, 0))


@_shape
def elliptical_vignette(height: int, width: int, rng: np.random.Generator) -> Layers:
    """As photo editors darken corners: by the way to the corner in units of the frame's sides."""
    x, y = _places(height, width)
    s = ((math.sqrt(2) * np.hypot(x - 0.5, y - 0.5) - 0.25) / 0.75).clip(0, 1)
    return _hiding(0.75 * s**2 * (3 - 2 * s), (0, 0, 0))


@_shape
def dark_frame(height: int, width: int, rng: np.random.Generator) -> Layers:
    """Soft, with round corners."""
    x, y = _places(height, width)
    s = ((2 * ((x - 0.5) ** 4 + (y - 0.5) ** 4) ** 0.25 - 0.6) / 0.4).clip(0, 1)
    return _hiding(0.8 * s, (0, 0, 0))


@_shape
def corner_panels(height: int, width: int, rng: np.random.Generator) -> Layers:
    """Translucent, as of a game."""
    x, y = _places(height, width)
    return _hiding(0.5 * ((abs(x - 0.5) > 0.28) & (abs(y - 0.5) > 0.28)).astype(float), (0.3, 0.3, 0.3))


@_shape
def fade_below(height: int, width: int, rng: np.random.Generator) -> Layers:
    return _hiding(0.85 * ((_places(height, width)[1] - 0.65) / 0.35).clip(0, 1), (0, 0, 0))


@_shape
def fade_above(height: int, width: int, rng: np.random.Generator) -> Layers:
    return _hiding(0.9 * (1 - _places(height, width)[1] / 0.4).clip(0, 1), (0, 0, 0))


@_shape
def white_fade(height: int, width: int, rng: np.random.Generator) -> Layers:
    return _hiding(0.85 * ((_places(height, width)[1] - 0.6) / 0.4).clip(0, 1), (1, 1, 1))


@_shape
def reflection(height: int, width: int, rng: np.random.Generator) -> Layers:
    """On a windscreen: smooth colored light in the lower half, up to 0.35."""
    light = _soft(rng.random((height, width, 3)), width / 14)
    light = (light - light.min()) / (light.max() - light.min())
    light *= 0.35 * ((_places(height, width)[1] - 0.3) / 0.4).clip(0, 1)[..., None]
    return Layers(np.ones((height, width, 3), np.float32), light.astype(np.float32))


@_shape
def white_frame(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, y = _places(height, width)
    inset = np.minimum(np.minimum(x, 1 - x) * width, np.minimum(y, 1 - y) * height) / height
    return _hiding(((inset > 0.03) & (inset < 0.06)).astype(float), (1, 1, 1))


@_shape
def hairs(height: int, width: int, rng: np.random.Generator) -> Layers:
    along, matte = np.linspace(0, 1, 400), np.zeros((height, width), np.float32)
    for number in range(3):
        across = 0.2 + 0.25 * number + 0.15 * np.sin(4 * along + 2 * number)
        curve = np.stack([width * (0.1 + 0.8 * along), height * across], axis=-1).astype(np.int32)
        cv2.polylines(matte, [curve], False, 1.0, max(2, height // 150), cv2.LINE_AA)
    return _hiding(0.8 * _soft(matte, height / 250), (0.1, 0.08, 0.06))


@_shape
def shadow(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, y = _places(height, width)
    return Layers.dimming(1 - 0.5 * np.exp(-(np.hypot((x - 0.3) / 0.28, (y - 0.6) / 0.33) ** 4)))


@_shape
def tinted_top(height: int, width: int, rng: np.random.Generator) -> Layers:
    share = ((0.55 - _places(height, width)[1]) / 0.1).clip(0, 1)[..., None]
    tint = 1 - share * (1 - np.array([0.75, 0.8, 0.95], np.float32))
    return Layers(tint.astype(np.float32), np.zeros((height, width, 3), np.float32))


@_shape
def plain_panel(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, y = _places(height, width)
    return _hiding(0.6 * ((abs(x - 0.22) < 0.18) & (abs(y - 0.75) < 0.2)), (0.2, 0.35, 0.7))


@_shape
def window_post(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, y = _places(height, width)
    distance = (x - 0.12 - 0.15 * (1 - y) * height / width) / 0.012
    return _hiding(1 / (1 + np.exp(distance.clip(-30, 30))), (0.05, 0.05, 0.05))


@_shape
def leaf(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, y = _places(height, width)
    return _hiding(0.75 * np.exp(-(np.hypot((x - 0.95) / 0.35, (y - 0.05) / 0.45) ** 3)), (0.15, 0.35, 0.1))


@_shape
def steering_wheel(height: int, width: int, rng: np.random.Generator) -> Layers:
    matte, middle = np.zeros((height, width), np.float32), (width // 2, int(1.15 * height))
    sides = int(0.42 * width), int(0.45 * height)
    cv2.ellipse(matte, middle, sides, 0, 0, 360, 1.0, int(0.07 * height), cv2.LINE_AA)
    return _hiding(matte, (0.07, 0.07, 0.08))


@_shape
def selfie_stick(height: int, width: int, rng: np.random.Generator) -> Layers:
    matte = np.zeros((height, width), np.float32)
    ends = (int(0.55 * width), height), (int(0.48 * width), int(0.45 * height))
    cv2.line(matte, *ends, 1.0, max(4, int(0.018 * width)), cv2.LINE_AA)
    return _hiding(_soft(matte, height / 400), (0.12, 0.12, 0.13))


@_shape
def cracks(height: int, width: int, rng: np.random.Generator) -> Layers:
    matte = np.zeros((height, width), np.float32)
    for angle in rng.uniform(0, 2 * math.pi, 9):
        steps = angle + np.cumsum(0.4 * rng.standard_normal(12))
        way = 0.07 * height * np.stack([np.cos(steps), np.sin(steps)], axis=-1).cumsum(axis=0)
        curve = (np.array([0.6 * width, 0.4 * height]) + way).astype(np.int32)
        cv2.polylines(matte, [curve], False, 1.0, max(1, height // 300), cv2.LINE_AA)
    return _hiding(0.7 * matte, (0.9, 0.93, 0.95))


@_shape
def tiled_text(height: int, width: int, rng: np.random.Generator) -> Layers:
    places = [(0.3 * column - 0.15 * (row % 2), 0.12 + 0.2 * row) for row in range(5) for column in range(4)]
    rows = [_text(height, width, "preview", place, 0.8, 2) for place in places]
    return _hiding(0.35 * np.max(rows, axis=0), (1, 1, 1))


@_shape
def subtitle(height: int, width: int, rng: np.random.Generator) -> Layers:
    line = "Where are the keys?", (0.12, 0.92), 0.75
    rim, inside = _text(height, width, *line, 6), _text(height, width, *line, 2)
    return _hiding(rim, np.repeat((inside / rim.clip(1e-6))[..., None], 3, axis=-1).clip(0, 1))


@_shape
def scan_lines(height: int, width: int, rng: np.random.Generator) -> Layers:
    transmittance = np.ones((height, width))
    transmittance[::3] = 0.75
    return Layers.dimming(transmittance)


@_shape
def flare(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, y = _places(height, width)
    source = np.hypot((x - 0.75) * width, (y - 0.25) * height) / height
    ghost = np.hypot((x - 0.3) * width, (y - 0.7) * height) / height
    light = 0.8 * np.exp(-((source / 0.08) ** 2)) + 0.25 * np.exp(-((source / 0.3) ** 2))
    light += 0.3 * np.exp(-(((ghost - 0.12) / 0.015) ** 2))
    return Layers(np.ones((height, width, 3), np.float32), light[..., None] * np.array([1, 0.9, 0.7], np.float32))


@_shape
def fog(height: int, width: int, rng: np.random.Generator) -> Layers:
    noise = _soft(rng.random((height, width)), width / 18)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    return _hiding(0.7 * ((noise - 0.55) / 0.3).clip(0, 1), (0.8, 0.82, 0.85))


@_shape
def sticker(height: int, width: int, rng: np.random.Generator) -> Layers:
    x, y = _places(height, width)
    inside = (abs(x - 0.875) < 0.075) & (abs(y - 0.125) < 0.075)
    return _hiding(_soft(inside, height / 60), (0.85, 0.85, 0.8))


if __name__ == "__main__":
    run_script(Command)
