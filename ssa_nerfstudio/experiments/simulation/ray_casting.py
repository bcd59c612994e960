"""Textured cuboids and the rays that meet them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ssa_nerfstudio.experiments.simulation.procedural_textures import TEXELS_PER_UNIT, draw_texture

_LIGHT = np.array([0.36, -0.48, 0.80])
"""Direction of the light that is baked into the textures."""


class Face(NamedTuple):
    """A textured rectangle, visible from the side that its normal points to."""

    center: np.ndarray
    """Scene units, [3]."""
    axes: np.ndarray
    """u, v and the normal as rows, [3, 3]."""
    half: tuple[float, float]
    """Half sizes along u and v, scene units."""
    texture: np.ndarray
    """Display colors, float32 [rows along v, columns along u, 3]."""


class Cuboid(NamedTuple):
    """Six faces, seen from inside or outside, and the radius of the sphere around them."""

    center: np.ndarray
    radius: float
    faces: list[Face]


def make_cuboid(
    number: int,
    center: tuple[float, ...],
    halves: tuple[float, ...],
    yaw: float,
    roll: float,
    *colors: tuple[int, ...],
    rng: np.random.Generator,
    inside: bool,
) -> Cuboid:
    """Build a cuboid, each face with its own texture and baked light.

    Args:
        number: decides which textures it has.
        center, halves: center and half sizes, scene units.
        yaw, roll: rotation about z, then about the rotated x, degrees.
        colors: dark and light color of the textures, sRGB, 0..255.
        rng: draws the textures.
        inside: whether the faces are visible from inside.
    """
    (cy, cr), (sy, sr) = np.cos(np.radians([yaw, roll])), np.sin(np.radians([yaw, roll]))
    rotation = np.array([[cy, -sy * cr, sy * sr], [sy, cy * cr, -cy * sr], [0, sr, cr]])
    faces = []
    for side in range(6):
        axis, sign = side // 2, 2 * (side % 2) - 1
        u, v = (other for other in range(3) if other != axis)
        normal = rotation[:, axis] * (-sign if inside else sign)
        half = (halves[u], halves[v])
        texture = draw_texture((number + side) % 6, half, np.array(colors) / 255, rng) * (0.7 + 0.4 * normal @ _LIGHT)
        middle = np.array(center) + sign * halves[axis] * rotation[:, axis]
        axes = np.stack([rotation[:, u], rotation[:, v], normal])
        faces.append(Face(middle, axes, half, texture.clip(0, 1).astype(np.float32)))
    return Cuboid(np.array(center), float(np.linalg.norm(halves)), faces)


def trace(cuboids: Sequence[Cuboid], origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Follow rays to the first surface that they meet.

    Args:
        cuboids: the scene, in any order.
        origin: origin of all rays, [3], scene units.
        directions: [N, 3], of any length.

    Returns:
        Distance in multiples of `directions` [N] and display color [N, 3] in [0, 1], both float32.
    """
    rays = np.ascontiguousarray(directions.T, dtype=np.float32)
    depth = np.full(rays.shape[1], np.inf, dtype=np.float32)
    color = np.zeros((rays.shape[1], 3), dtype=np.float32)
    lengths = np.square(rays).sum(axis=0)
    for cuboid in cuboids:
        offset = (cuboid.center - origin).astype(np.float32)
        # The angle between a ray and the way to the bounding sphere's center tells whether the ray meets the sphere.
        near = np.flatnonzero(np.square(offset @ rays) >= (offset @ offset - cuboid.radius**2) * lengths)
        bundle = rays.take(near, axis=1)
        for face in cuboid.faces:
            u0, v0, n0 = (face.axes @ (origin - face.center)).astype(np.float32)
            if n0 <= 0:
                continue
            du, dv, dn = face.axes.astype(np.float32) @ bundle
            with np.errstate(divide="ignore", invalid="ignore"):
                t = -n0 / dn
                u, v = u0 + t * du, v0 + t * dv
            # The margin closes the hairline between faces that share an edge.
            inside = (np.abs(u) <= face.half[0] + 1e-4) & (np.abs(v) <= face.half[1] + 1e-4)
            hits = np.flatnonzero(inside & (t > 0) & (t < depth[near]))
            depth[near[hits]] = t[hits]
            rows, columns, _ = face.texture.shape
            row = ((v[hits] + face.half[1]) * TEXELS_PER_UNIT).astype(int).clip(0, rows - 1)
            column = ((u[hits] + face.half[0]) * TEXELS_PER_UNIT).astype(int).clip(0, columns - 1)
            color[near[hits]] = face.texture[row, column]
    return depth, color
