"""A reconstruction as a nerfstudio dataset: transforms.json, sparse_pc.ply and COLMAP's model, as ns-process-data has
them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssa_nerfstudio.data.panorama_entry import panorama_entry
from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.data.sparse_points import write_points
from ssa_nerfstudio.sfm.ingest import Photo, remove_records

if TYPE_CHECKING:
    import pycolmap

APPLIED_TRANSFORM = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""From COLMAP's world, whose first camera looks along z with y down, to nerfstudio's with z up, [3, 4]."""
POINTS = "sparse_pc.ply"
"""File of the points."""
MASK = "mask_colmap.png"
"""File of the mask of the first pass: black is ignored, as by COLMAP and nerfstudio."""
_INTRINSICS = {
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""COLMAP's parameters by the model that they are of."""


def write_dataset(
    dataset: Path,
    photos: Sequence[Photo],
    tests: Set[str],
    model: pycolmap.Reconstruction,
    masks: Sequence[Path],
    panoramas: Source | None = None,
) -> None:
    """Complete a dataset that has its photos already; transforms.json comes last.

    Args:
        dataset: folder that holds images/.
        photos: all of them.
        tests: names of those that test; without any, no split is stated.
        model: their reconstruction.
        masks: files of the masks that were used, to copy.
        panoramas: equirectangular photos whose faces the photos are.
    """
    sparse = dataset / "colmap" / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    model.write_binary(sparse)
    points = list(model.points3D.values())
    positions = np.array([point.xyz for point in points]).reshape(-1, 3) @ APPLIED_TRANSFORM[:, :3].T
    write_points(dataset / POINTS, positions, np.array([point.color for point in points]).reshape(-1, 3))
    for mask in masks:
        shutil.copy(mask, dataset)
    meta = transforms(model, {photo.name: photo.source for photo in photos})
    if tests:
        meta = split(meta, [p.name for p in photos if p.name not in tests], [p.name for p in photos if p.name in tests])
    if panoramas is not None:
        meta |= panorama_entry(panoramas.width, panoramas.faces)
    remove_records(dataset)
    (dataset / "transforms.json").write_text(json.dumps(meta, indent=1), encoding="utf-8")


def transforms(reconstruction: pycolmap.Reconstruction, sources: Mapping[str, str]) -> dict[str, Any]:
    """Contents of transforms.json for the registered photos, without a split.

    A single camera is stated once, several are stated in their frames. Poses are camera to world with OpenGL axes, as
    in `nerfstudio.process_data.colmap_utils.colmap_to_json`.

    Args:
        reconstruction: its cameras are of one model, OPENCV or OPENCV_FISHEYE.
        sources: for each photo the file that it was made from.
    """
    cameras = {number: _intrinsics(camera) for number, camera in reconstruction.cameras.items()}
    images = sorted((image for image in reconstruction.images.values() if image.has_pose), key=lambda image: image.name)
    seen = {image.camera_id for image in images}
    shared = cameras[images[0].camera_id] if len(seen) == 1 else {}
    frames = [
        {
            "file_path": f"images/{image.name}",
            "transform_matrix": _pose(image).tolist(),
            "source_name": sources[image.name],
            **({} if shared else cameras[image.camera_id]),
        }
        for image in images
    ]
    return {
        "camera_model": reconstruction.cameras[images[0].camera_id].model.name,
        **shared,
        "applied_transform": APPLIED_TRANSFORM.tolist(),
        "ply_file_path": POINTS,
        "frames": frames,
    }


def split(meta: dict[str, Any], train: Sequence[str], test: Sequence[str]) -> dict[str, Any]:
    """Contents of transforms.json with the registered photos of two passes as training and test split.

    Args:
        meta: contents without a split.
        train, test: photos of the passes, files in images/.
    """
    registered = {frame["file_path"] for frame in meta["frames"]}
    lists = [[path for path in (f"images/{name}" for name in names) if path in registered] for names in (train, test)]
    return {**meta, "train_filenames": lists[0], "val_filenames": lists[1], "test_filenames": lists[1]}


def _pose(image: pycolmap.Image) -> np.ndarray:
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    pose[:3, 1:3] *= -1
    return np.vstack([APPLIED_TRANSFORM, [0, 0, 0, 1]]) @ pose


def _intrinsics(camera: pycolmap.Camera) -> dict[str, float]:
    names = _INTRINSICS[camera.model.name]
    return {"w": camera.width, "h": camera.height, **dict(zip(names, map(float, camera.params), strict=True))}
