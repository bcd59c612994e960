"""Equirectangular photos as six overlapping perspective faces with fixed directions, and faces back as one picture.

Axes are OpenCV's, x right, y down, z forward; the middle of the panorama looks forward.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import get_args

import cv2
import numpy as np

from ssa_nerfstudio.cameras.projections import FaceName

FACE_NAMES: tuple[FaceName, ...] = get_args(FaceName)
_AXES: dict[FaceName, tuple[tuple[int, int, int], ...]] = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""Each face's x, y and z axis in the panorama's axes."""
_FOCAL, _FOCAL_STEP = 0.483, 0.003
"""Focal length of the front face, and by how much that of each next one is shorter, of the face's width: 92 to 94
degrees. Training tells cameras apart by their intrinsics (`groups.INTRINSICS_TOLERANCE`), and each face has an overlay
of its own; beyond 90 degrees neighbors overlap."""


@dataclass(frozen=True)
class Face:
    """A square perspective camera without distortion that looks from the panorama's center in a fixed direction."""

    name: FaceName
    size: int
    """Width and height, pixels."""

    @property
    def focal(self) -> float:
        """Focal length, pixels; the principal point is the middle."""
        return self.size * (_FOCAL - _FOCAL_STEP * FACE_NAMES.index(self.name))

    @property
    def from_panorama(self) -> np.ndarray:
        """Rotation [3, 3] of directions from the panorama's axes to the face's."""
        return np.array(_AXES[self.name], float)

    def pixels(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the face sees directions [..., 3] in the panorama's axes.

        Returns:
            Positions [..., 2] in pixels, (0, 0) the outer corner of the first; and depth along z, positive in front.
        """
        x, y, depth = np.moveaxis(directions @ self.from_panorama.T, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            positions = self.focal * np.stack([x, y], axis=-1) / depth[..., None] + self.size / 2
        return positions, depth


def panorama_faces(width: int, left_out: Collection[FaceName] = ()) -> tuple[Face, ...]:
    """Faces of a panorama, in whose middles a pixel covers the angle that one of the panorama's does.

    Args:
        width: of the panorama, pixels.
        left_out: names of those that are not wanted.
    """
    size = 2 * max(1, round(width / (2 * np.pi) / _FOCAL / 2))
    return tuple(Face(name, size) for name in FACE_NAMES if name not in left_out)


def cut(panorama: np.ndarray, face: Face) -> np.ndarray:
    """Draw a face of a panorama, bilinearly.

    Args:
        panorama: uint8 or float32 [H, W, C] or [H, W]; its left and right edge are neighbors.
        face: which.

    Returns:
        [size, size, C] or [size, size].
    """
    height, width = panorama.shape[:2]
    axis = (np.arange(face.size) + 0.5 - face.size / 2) / face.focal
    x, y = np.meshgrid(axis, axis)
    x, y, z = np.moveaxis(np.stack([x, y, np.ones_like(x)], axis=-1) @ face.from_panorama, -1, 0)
    column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width
    row = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * height
    wrapped = cv2.copyMakeBorder(panorama, 0, 0, 1, 1, cv2.BORDER_WRAP)
    # OpenCV's (0, 0) is the center of the first pixel, which is the wrapped column here.
    maps = (column + 0.5).astype(np.float32), (row - 0.5).astype(np.float32)
    return cv2.remap(wrapped, *maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def compose(pictures: Sequence[tuple[Face, np.ndarray]], width: int) -> tuple[np.ndarray, np.ndarray]:
    """Put pictures of faces together to a panorama; where faces overlap they are blended.

    Weights fall linearly to 0 towards a face's border, so that no seam is left.

    Args:
        pictures: faces, each with its picture, float32 [size, size, C].
        width: of the panorama, pixels, even.

    Returns:
        The panorama, float32 [width / 2, width, C], 0 where no face looks; and where one does, bool [width / 2, width].
    """
    height = width // 2
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5)[:, None] * np.pi
    around = np.cos(latitude)
    directions = np.stack(
        np.broadcast_arrays(around * np.sin(longitude), np.sin(latitude), around * np.cos(longitude)), -1
    )
    total = np.zeros((height, width, pictures[0][1].shape[-1]), np.float32)
    weights = np.zeros((height, width, 1), np.float32)
    for face, picture in pictures:
        positions, depth = face.pixels(directions)
        inside = (depth > 0) & (positions > 0).all(axis=-1) & (positions < face.size).all(axis=-1)
        positions = np.where(inside[..., None], positions, 0)
        # Half a pixel at least, so that a direction that only one face sees is known.
        margin = np.minimum(positions, face.size - positions).min(axis=-1) + 0.5
        weight = np.where(inside, margin, 0).astype(np.float32)[..., None]
        x, y = (positions[..., axis].astype(np.float32) - np.float32(0.5) for axis in (0, 1))
        seen = cv2.remap(picture, x, y, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        total += weight * seen.reshape(total.shape)
        weights += weight
    return total / np.maximum(weights, np.float32(1e-6)), weights[..., 0] > 0


def owned_by_neighbors(face: Face, others: Sequence[Face], scale: int = 1) -> list[tuple[Face, np.ndarray, np.ndarray]]:
    """Which pixels of a face look where another one looks closer to its middle, and where those are in the other.

    Each direction has one owner: the face whose axis is nearest, of those that see it.

    Args:
        face: which.
        others: the other faces, of the same size.
        scale: side of a pixel in the face's own ones; more than 1 for an overlay of lower resolution.

    Returns:
        For each owner: numbers of the face's pixels [P], row by row, and positions [P, 2] in the owner's pixels, (0, 0)
        the outer corner of the first.
    """
    side = -(-face.size // scale)
    axis = ((np.arange(side) + 0.5) * scale - face.size / 2) / face.focal
    x, y = (each.ravel() for each in np.meshgrid(axis, axis))
    beyond = np.flatnonzero(np.maximum(np.abs(x), np.abs(y)) > 1)  # 45 degrees; all others are its own
    directions = np.stack([x[beyond], y[beyond], np.ones(len(beyond))], axis=-1) @ face.from_panorama
    nearest = np.ones(len(beyond))
    owner, found = np.full(len(directions), -1), np.zeros((len(directions), 2))
    for number, other in enumerate(others):
        positions, depth = other.pixels(directions)
        closer = depth > nearest  # within 45 degrees of the other's axis, so inside of its frame
        owner[closer], found[closer], nearest[closer] = number, positions[closer] / scale, depth[closer]
    return [
        (other, beyond[owner == number], found[owner == number])
        for number, other in enumerate(others)
        if (owner == number).any()
    ]


def hidden_by_neighbors(face: Face, neighbors: Sequence[tuple[Face, np.ndarray]]) -> np.ndarray:
    """Layers of other faces where these overlap with a face, in the face's frame; of several the least transmittance.

    Args:
        face: which.
        neighbors: other faces of the same size, each with its layers T and B, float32 [size, size, 4].

    Returns:
        Layers [size, size, 4]; clear (1, 0, 0, 0) where no other face looks.
    """
    axis = (np.arange(face.size) + 0.5 - face.size / 2) / face.focal
    x, y = np.meshgrid(axis, axis)
    # Others look no further than the tangent of half their angle of view.
    border = np.maximum(np.abs(x), np.abs(y)) >= min(
        (2 * other.focal / other.size for other, _ in neighbors), default=1
    )
    directions = np.stack([x[border], y[border], np.ones(border.sum())], axis=-1) @ face.from_panorama
    at_border = np.tile(np.array([1, 0, 0, 0], np.float32), (len(directions), 1))
    for other, layers in neighbors:
        positions, depth = other.pixels(directions)
        inside = (depth > 0) & (positions > 0).all(axis=-1) & (positions < other.size).all(axis=-1)
        column, row = np.where(inside[:, None], positions, 0).astype(int).T
        seen = layers[row, column]
        more = inside & (seen[:, 0] < at_border[:, 0])
        at_border[more] = seen[more]
    found = np.tile(np.array([1, 0, 0, 0], np.float32), (face.size, face.size, 1))
    found[border] = at_border
    return found
