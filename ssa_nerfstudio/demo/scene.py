"""A synthetic capture whose every pixel is known: a textured room with boxes, ray-cast from an arc of cameras."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from ssa_nerfstudio.effects.layers import Layers

_ROOM = (4.4, 4.4, 3.6)
"""Half width, half depth and height of the room, scene units."""
_BOXES = (
    ((0.0, 0.1, 0.55), (0.45, 0.45, 0.55), 0.0, 0.0),
    ((0.05, 0.1, 1.48), (0.28, 0.28, 0.28), 30.0, 35.0),
    ((-1.15, -0.45, 0.35), (0.35, 0.50, 0.35), 25.0, 0.0),
    ((1.15, -0.55, 0.45), (0.40, 0.30, 0.45), -35.0, 0.0),
    ((0.95, 0.95, 0.90), (0.30, 0.30, 0.90), 15.0, 0.0),
    ((-0.95, 1.00, 0.25), (0.50, 0.35, 0.25), 0.0, 0.0),
    ((0.05, -1.20, 0.20), (0.30, 0.22, 0.20), 60.0, 0.0),
)
"""Centre, half sizes (scene units), yaw and roll (degrees) of each box; z is up, the floor at 0."""
_LIGHT = np.array([0.36, -0.48, 0.8])
_TEXELS = 72
"""Texture resolution, texels per scene unit: finer than a pixel of the default camera at any distance."""
_SUPERSAMPLING = 3
_SPARSE_POINTS = 4000
_SPARSE_NOISE = 0.005
"""Standard deviation of the sparse points' positions about the surface, scene units."""


@dataclass(frozen=True)
class DemoScene:
    """The demo's scene and cameras; everything in it follows from the fields.

    Raises:
        ValueError: a field is out of its range.
    """

    views: int = 48
    """Training views, at least 2."""
    test_views: int = 8
    """Held-out views, evenly interleaved between the training views; from 1 to `views`."""
    width: int = 160
    """Image width, pixels, at least 1."""
    height: int = 112
    """Image height, pixels, at least 1."""
    fov_x: float = 65.0
    """Horizontal field of view, degrees, in (0, 180)."""
    seed: int = 0
    """Seed of textures, camera path and sparse points; not negative."""

    def __post_init__(self) -> None:
        bounds = {"views": (2, None), "test_views": (1, self.views), "width": (1, None), "height": (1, None)}
        for name, (lowest, highest) in {**bounds, "seed": (0, None)}.items():
            value = getattr(self, name)
            if value < lowest or (highest is not None and value > highest):
                limits = f"at least {lowest}" if highest is None else f"in [{lowest}, {highest}]"
                raise ValueError(f"DemoScene.{name} must be {limits}, got {value}")
        if not 0 < self.fov_x < 180:
            raise ValueError(f"DemoScene.fov_x must be in (0, 180) degrees, got {self.fov_x}")

    @property
    def focal_length(self) -> float:
        """Focal length in pixels, the same along both axes; the principal point is the image's centre."""
        return self.width / 2 / np.tan(np.radians(self.fov_x) / 2)

    @cached_property
    def cameras(self) -> tuple[np.ndarray, np.ndarray]:
        """Camera-to-world matrices of training [views, 4, 4] and test cameras [test_views, 4, 4].

        OpenGL axes: x right, y up, z backwards. Height and pitch jump from view to view, so that what the lower
        part of one frame shows is higher up in others.
        """
        count = self.views + self.test_views
        index = np.arange(count)
        # Irrational steps spread every quantity evenly over its range in any run of neighbouring views.
        start = np.random.default_rng([self.seed, 1]).uniform(size=5)
        spread = (start + index[:, None] * (np.sqrt([2, 3, 5, 7, 11]) % 1)) % 1
        azimuth = np.radians(-190 + 200 * (index + 0.5) / count)
        radius = 2.7 + 0.9 * spread[:, 0]
        position = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), 0.7 + 2.3 * spread[:, 1]], axis=1)
        target = np.stack([1.6 * spread[:, 2] - 0.8, 1.6 * spread[:, 3] - 0.8, 2.9 * spread[:, 4] - 1.0], axis=1)

        back = _normalised(position - target)
        right = _normalised(np.cross([0.0, 0.0, 1.0], back))
        pose = np.tile(np.eye(4), (count, 1, 1))
        pose[:, :3] = np.stack([right, np.cross(back, right), back, position], axis=2)
        held_out = np.zeros(count, dtype=bool)
        held_out[((np.arange(self.test_views) + 0.5) * count / self.test_views).astype(int)] = True
        return pose[~held_out], pose[held_out]

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Follows rays to the first surface they meet.

        Args:
            origin: where all rays start, [3], inside the room and outside the boxes.
            directions: [N, 3], of any length.

        Returns:
            Distance in multiples of `directions` [N] and display colour [N, 3] in [0, 1], both float32.
        """
        rays = np.ascontiguousarray(directions.T, dtype=np.float32)
        count = rays.shape[1]
        depth = np.full(count, np.inf, dtype=np.float32)
        surface, across, along = np.zeros(count, dtype=np.int32), np.zeros_like(depth), np.zeros_like(depth)
        for number, face in enumerate(self._faces):
            u0, v0, n0 = face.axes @ (origin - face.centre)
            if n0 <= 0:
                continue
            du, dv, dn = face.axes.astype(np.float32) @ rays
            with np.errstate(divide="ignore", invalid="ignore"):
                t = np.float32(-n0) / dn
                u, v = np.float32(u0) + t * du, np.float32(v0) + t * dv
            # The margin closes the hairline between faces that share an edge.
            inside = (np.abs(u) <= face.half[0] + 1e-4) & (np.abs(v) <= face.half[1] + 1e-4)
            nearer = np.flatnonzero(inside & (t > 0) & (t < depth))
            depth[nearer], surface[nearer], across[nearer], along[nearer] = t[nearer], number, u[nearer], v[nearer]
        return depth, self._colour(surface, across, along)

    def render(self, camera_to_world: np.ndarray) -> np.ndarray:
        """The clean photo of one camera, uint8 [height, width, 3]; 3 x 3 rays a pixel, box-filtered.

        Args:
            camera_to_world: [4, 4], OpenGL axes.
        """
        steps = _SUPERSAMPLING
        x = (np.arange(self.width * steps) + 0.5) / steps
        y = (np.arange(self.height * steps) + 0.5) / steps
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        _, colour = self.trace(camera_to_world[:3, 3], self.ray_directions(camera_to_world, pixels))
        colour = colour.reshape(self.height, steps, self.width, steps, 3).mean(axis=(1, 3))
        return np.rint(colour * 255).astype(np.uint8)

    def ray_directions(self, camera_to_world: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """World directions [N, 3] of unit depth through pixel positions [N, 2] (x right, y down, corner at 0, 0)."""
        x = (pixels[:, 0] - self.width / 2) / self.focal_length
        y = (self.height / 2 - pixels[:, 1]) / self.focal_length
        return np.stack([x, y, -np.ones_like(x)], axis=1) @ camera_to_world[:3, :3].T

    def sparse_points(self) -> tuple[np.ndarray, np.ndarray]:
        """What structure from motion would find: points on surfaces the training cameras see.

        Returns:
            Positions [4000, 3] with noise of 0.005 scene units and display colours uint8 [4000, 3].
        """
        rng = np.random.default_rng([self.seed, 2])
        train, _ = self.cameras
        points, colours = [], []
        for pose, share in zip(train, np.array_split(np.arange(_SPARSE_POINTS), len(train)), strict=True):
            directions = self.ray_directions(pose, rng.uniform(size=(len(share), 2)) * [self.width, self.height])
            depth, colour = self.trace(pose[:3, 3], directions)
            points.append(pose[:3, 3] + depth[:, None] * directions)
            colours.append(np.rint(colour * 255).astype(np.uint8))
        noise = rng.normal(scale=_SPARSE_NOISE, size=(_SPARSE_POINTS, 3))
        return np.concatenate(points) + noise, np.concatenate(colours)

    def write(self, output: Path, artifact: Layers | None) -> None:
        """Writes the capture as a nerfstudio dataset: images, transforms.json and sparse_pc.ply.

        The folder appears only when complete.

        Args:
            output: folder to make; its parent is made where missing.
            artifact: laid over the training images at their size, or None; test images stay clean.

        Raises:
            FileExistsError: `output` exists already.
            ValueError: the artifact is not of the images' size.
        """
        if output.exists():
            raise FileExistsError(f"{output} exists already: remove it or name another folder")
        if artifact is not None and artifact.transmittance.shape != (self.height, self.width, 3):
            size = artifact.transmittance.shape[:2]
            raise ValueError(f"artifact is {size}, the scene's images are {(self.height, self.width)} (height, width)")
        output.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as scratch:
            dataset = Path(scratch) / output.name
            (dataset / "images").mkdir(parents=True)
            frames = []
            for split, poses in zip(("train", "test"), self.cameras, strict=True):
                for number, pose in enumerate(poses):
                    image = self.render(pose)
                    if artifact is not None and split == "train":
                        image = artifact.apply(image)
                    name = f"images/{split}_{number:04d}.png"
                    Image.fromarray(image).save(dataset / name)
                    frames.append({"file_path": name, "transform_matrix": pose.tolist()})
            _write_ply(dataset / "sparse_pc.ply", *self.sparse_points())
            (dataset / "transforms.json").write_text(json.dumps(self._transforms(frames), indent=2))
            dataset.rename(output)
