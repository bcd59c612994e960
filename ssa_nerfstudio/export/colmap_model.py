"""A dataset's cameras, poses and points as a model of COLMAP, which most programs read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ssa_nerfstudio._system.pycolmap_import import import_pycolmap
from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.data.sparse_points import read_points
from ssa_nerfstudio.data.writing import is_text
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.training.nonfinite import finite_points

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class PosedPhoto:
    """One photo of the model."""

    name: str
    """Its path below images/."""
    lens: Lens
    pose: np.ndarray
    """Camera to nerfstudio's world, OpenGL axes, [4, 4]."""


def write_colmap_model(folder: Path, photos: Sequence[PosedPhoto], meta: dict[str, Any], points: Path | None) -> int:
    """Write cameras.bin, images.bin, points3D.bin, and the rigs and frames of COLMAP 4.

    The points have no tracks; those that are not finite are left out, as by a training. Everything is in COLMAP's
    world, where `applied_transform` has been undone.

    Args:
        folder: the model's; made where missing.
        photos: in the order of their numbers.
        meta: contents of transforms.json.
        points: a PLY file in nerfstudio's world; None: the model has no points.

    Returns:
        The number of points.

    Raises:
        InputError: the points cannot be read, or a photo's name is no text.
    """
    pycolmap = import_pycolmap()
    applied = np.eye(4)
    applied[:3] = meta.get("applied_transform", applied[:3])
    to_colmap = np.linalg.inv(applied)
    model = pycolmap.Reconstruction()
    numbers: dict[Lens, int] = {}
    for number, photo in enumerate(photos, 1):
        if not is_text(photo.name):
            raise InputError(f"the name of {photo.name} is no text in UTF-8", "rename the photo")
        if photo.lens not in numbers:
            numbers[photo.lens] = len(numbers) + 1
            model.add_camera_with_trivial_rig(_camera(pycolmap, numbers[photo.lens], photo.lens))
        image = pycolmap.Image(name=photo.name, camera_id=numbers[photo.lens], image_id=number)
        world_to_camera = np.linalg.inv(to_colmap @ photo.pose @ _FROM_OPENGL)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world_to_camera[:3]))
    count = 0
    if points is not None:
        places, colors = map(torch.from_numpy, read_points(points))
        finite = finite_points((places, colors))
        for place, color in zip(*finite, strict=True) if finite else ():
            model.add_point3D(to_colmap[:3, :3] @ place.numpy() + to_colmap[:3, 3], pycolmap.Track(), color.numpy())
        count = model.num_points3D()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    return count


def _camera(pycolmap: Any, number: int, lens: Lens) -> Any:
    k1, k2, k3, k4, p1, p2 = lens.distortion
    center = [lens.fx, lens.fy, lens.cx, lens.cy]
    if not lens.distorted:
        kind, params = "PINHOLE", center
    elif lens.model == "fisheye":
        kind, params = "OPENCV_FISHEYE", [*center, k1, k2, k3, k4]
    elif k3 == 0:
        kind, params = "OPENCV", [*center, k1, k2, p1, p2]
    else:
        kind, params = "FULL_OPENCV", [*center, k1, k2, p1, p2, k3, 0, 0, 0]
    return pycolmap.Camera(camera_id=number, model=kind, width=lens.width, height=lens.height, params=params)
