"""A smooth arc of cameras in the built-in scene, whose renders are the fixture `photos`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 224, 168
"""Of the photos, pixels."""


def poses(count: int) -> np.ndarray:
    """Cameras to world [count, 4, 4] on an arc of 5 degrees a view, bobbing, looking into the room; OpenGL axes."""
    index = np.arange(count)
    azimuth = np.radians(-120 + 5 * index)
    height = 1.5 + 0.5 * np.sin(1.7 * index)
    position = np.stack([3.4 * np.cos(azimuth), 3.4 * np.sin(azimuth), height], axis=1)
    back = position - [0, 0, 0.5]
    right = np.cross([0.0, 0.0, 1.0], back)
    axes = np.stack([right, np.cross(back, right), back], axis=2)
    result = np.tile(np.eye(4), (count, 1, 1))
    result[:, :3, :3] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    result[:, :3, 3] = position
    return result


def write(folder: Path, pictures: list[np.ndarray], suffix: str = ".png", **options) -> Path:
    """A folder of photos, photo_0, photo_1, ..., photo_10: in this order only if numbers count as numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"photo_{number}{suffix}", **options)
    return folder
