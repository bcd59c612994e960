"""A synthetic capture with known poses and clean photos: a textured room with boxes, seen from an arc of cameras."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from ssa_nerfstudio.data.sparse_points import write_points
from ssa_nerfstudio.data.writing import staged_folder
from ssa_nerfstudio.experiments.simulation.ray_casting import Cuboid, make_cuboid, trace

if TYPE_CHECKING:
    from ssa_nerfstudio.experiments.effects.layers import Layers

_CUBOIDS = (
    ((0.00, 0.00, 1.80), (4.40, 4.40, 1.80), 0, 0, (70, 62, 58), (212, 188, 154)),
    ((0.00, 0.10, 0.55), (0.45, 0.45, 0.55), 0, 0, (38, 52, 84), (226, 196, 120)),
    ((0.05, 0.10, 1.49), (0.28, 0.28, 0.28), 30, 35, (122, 34, 30), (240, 214, 190)),
    ((-1.15, -0.45, 0.35), (0.35, 0.50, 0.35), 25, 0, (24, 82, 70), (206, 226, 150)),
    ((1.15, -0.55, 0.45), (0.40, 0.30, 0.45), -35, 0, (70, 34, 96), (246, 170, 92)),
    ((0.95, 0.95, 0.90), (0.30, 0.30, 0.90), 15, 0, (28, 28, 36), (232, 232, 224)),
    ((-0.95, 1.00, 0.25), (0.50, 0.35, 0.25), 0, 0, (20, 88, 140), (250, 226, 96)),
    ((0.05, -1.20, 0.20), (0.30, 0.22, 0.20), 60, 0, (126, 70, 28), (160, 214, 226)),
)
"""Center and half sizes (scene units, z up, floor at 0), yaw and roll (degrees), dark and light texture color (sRGB).

The first is the room, visible from inside; the others are the boxes in it.
"""
_SUPERSAMPLING = 3
_SPARSE_POINTS = 4000
_SPARSE_NOISE = 0.005


@dataclass(frozen=True)
class DemoScene:
    """The demo's scene and cameras, which the fields determine.

    Raises:
        ValueError: a field is out of its range.
    """

    views: int = 48
    """Training views, at least 2."""
    test_views: int = 8
    """Held-out views, spread evenly between the training views; from 1 to `views`."""
    width: int = 160
    """Image width, pixels, at least 1."""
    height: int = 112
    """Image height, pixels, at least 1."""
    fov_x: float = 65.0
    """Horizontal field of view, degrees, in (0, 180)."""
    seed: int = 0
    """Seed of textures, camera path and sparse points; not negative."""

    def __post_init__(self) -> None:
        for name, lowest in (("views", 2), ("test_views", 1), ("width", 1), ("height", 1), ("seed", 0)):
            if getattr(self, name) < lowest:
                raise ValueError(f"DemoScene.{name} must be at least {lowest}, got {getattr(self, name)}")
        if self.test_views > self.views:
            raise ValueError(f"DemoScene.test_views must be in [1, views = {self.views}], got {self.test_views}")
        if not 0 < self.fov_x < 180:
            raise ValueError(f"DemoScene.fov_x must be in (0, 180) degrees, got {self.fov_x}")

    @property
    def focal_length(self) -> float:
        """Focal length in pixels along both axes; the principal point is the image's center."""
        return float(self.width / 2 / np.tan(np.radians(self.fov_x) / 2))

    @cached_property
    def cameras(self) -> tuple[np.ndarray, np.ndarray]:
        """Camera-to-world matrices of training [views, 4, 4] and test cameras [test_views, 4, 4].

        OpenGL axes (x right, y up, z backwards). Height and pitch jump from view to view, so that what the lower
        part of one frame shows is higher up in others.
        """
        count = self.views + self.test_views
        index = np.arange(count)
        # Irrational steps spread every quantity evenly over its range in any run of neighboring views.
        start = np.random.default_rng([self.seed, 1]).uniform(size=5)
        spread = (start + index[:, None] * (np.sqrt([2, 3, 5, 7, 11]) % 1)) % 1
        lowest, highest = np.array([3.1, 0.6, -0.8, -0.8, -1.4]), np.array([3.9, 3.0, 0.8, 0.8, 1.5])
        radius, elevation, *target = (lowest + (highest - lowest) * spread).T
        azimuth = -np.pi * (index + 0.5) / count
        position = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), elevation], axis=1)

        back = position - np.stack(target, axis=1)
        right = np.cross([0.0, 0.0, 1.0], back)
        axes = np.stack([right, np.cross(back, right), back], axis=2)
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3, :3] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        poses[:, :3, 3] = position
        held_out = ((np.arange(self.test_views) + 0.5) * count / self.test_views).astype(int)
        return np.delete(poses, held_out, axis=0), poses[held_out]

    def rays(self, camera_to_world: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return world directions [N, 3], of depth 1, through positions [N, 2] in pixels from the upper left corner."""
        x = (pixels[:, 0] - self.width / 2) / self.focal_length
        y = (self.height / 2 - pixels[:, 1]) / self.focal_length
        return np.stack([x, y, -np.ones_like(x)], axis=1) @ camera_to_world[:3, :3].T

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Follow rays from inside the room and outside the boxes; see `ray_casting.trace`."""
        return trace(self._cuboids, origin, directions)

    def render(self, camera_to_world: np.ndarray) -> np.ndarray:
        """Render one camera's clean photo, uint8 [height, width, 3]: 3 x 3 rays per pixel, box-filtered.

        Args:
            camera_to_world: [4, 4], OpenGL axes.
        """
        steps = _SUPERSAMPLING
        x, y = ((np.arange(side * steps) + 0.5) / steps for side in (self.width, self.height))
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        _, color = self.trace(camera_to_world[:3, 3], self.rays(camera_to_world, pixels))
        color = color.reshape(self.height, steps, self.width, steps, 3).mean(axis=1).mean(axis=2)
        return np.rint(color * 255).astype(np.uint8)

    def sparse_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Sample what structure from motion would find: noisy points on surfaces that training cameras see.

        Returns:
            Positions [4000, 3] (standard deviation 0.005 scene units) and display colors uint8 [4000, 3].
        """
        rng = np.random.default_rng([self.seed, 2])
        train, _ = self.cameras
        points, colors = [], []
        for pose, share in zip(train, np.array_split(np.arange(_SPARSE_POINTS), len(train)), strict=True):
            directions = self.rays(pose, rng.uniform(size=(len(share), 2)) * [self.width, self.height])
            depth, color = self.trace(pose[:3, 3], directions)
            points.append(pose[:3, 3] + depth[:, None] * directions)
            colors.append(np.rint(color * 255).astype(np.uint8))
        noise = rng.normal(scale=_SPARSE_NOISE, size=(_SPARSE_POINTS, 3))
        return np.concatenate(points) + noise, np.concatenate(colors)

    def write(self, output: Path, artifact: Layers | None) -> None:
        """Write the capture as a nerfstudio dataset: images/, transforms.json and sparse_pc.ply.

        Args:
            output: folder to make; it appears only when complete, its parent is made where missing.
            artifact: composited over the training images, or None; test images stay clean.

        Raises:
            InputError: `output` exists or cannot be written.
            ValueError: the artifact is not of the images' size.
        """
        if artifact is not None and artifact.transmittance.shape != (self.height, self.width, 3):
            height, width, _ = artifact.transmittance.shape
            raise ValueError(f"artifact is {width} x {height}, the scene's images are {self.width} x {self.height}")
        with staged_folder(output) as dataset:
            (dataset / "images").mkdir()
            names: dict[str, list[str]] = {}
            for split, poses in zip(("train", "test"), self.cameras, strict=True):
                names[split] = [f"images/{split}_{number:04d}.png" for number in range(len(poses))]
                for name, pose in zip(names[split], poses, strict=True):
                    photo = self.render(pose)
                    if artifact is not None and split == "train":
                        photo = artifact.apply(photo)
                    Image.fromarray(photo).save(dataset / name)
            write_points(dataset / "sparse_pc.ply", *self.sparse_points())
            (dataset / "transforms.json").write_text(json.dumps(self._transforms(names["train"], names["test"])))

    def _transforms(self, train: list[str], test: list[str]) -> dict[str, object]:
        poses = np.concatenate(self.cameras).tolist()
        return {
            "camera_model": "OPENCV",
            "fl_x": self.focal_length,
            "fl_y": self.focal_length,
            "cx": self.width / 2,
            "cy": self.height / 2,
            "w": self.width,
            "h": self.height,
            "ply_file_path": "sparse_pc.ply",
            "train_filenames": train,
            "val_filenames": test,
            "test_filenames": test,
            "frames": [
                {"file_path": name, "transform_matrix": pose} for name, pose in zip(train + test, poses, strict=True)
            ],
        }

    @cached_property
    def _cuboids(self) -> list[Cuboid]:
        rng = np.random.default_rng([self.seed, 0])
        return [make_cuboid(number, *geometry, rng=rng, inside=number == 0) for number, geometry in enumerate(_CUBOIDS)]
