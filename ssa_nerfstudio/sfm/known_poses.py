"""Poses that are known before structure from motion: kept where the photos agree with them.

Runs in the child process of `reconstruction.py`, after features are matched.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

MIN_AGREEING = 0.5
"""Share of a photo's matches that have to agree with its pose, and of the poses that have to be kept. By chance a
quarter of the matches agree, of neighbors' up to two thirds."""
MAX_ERROR = 4.0
"""Of a match, pixels from the epipolar line: what COLMAP lets pass when it verifies matches."""


def triangulate(database: Path, images: Path, poses: Mapping[str, np.ndarray], folder: Path) -> set[str]:
    """Triangulate the matches of photos whose poses are known, without the poses that the matches contradict.

    Args:
        database: of features and matches; its cameras are used as they are.
        images: folder of the photos.
        poses: camera from world [3, 4], COLMAP's axes, by the photo's name.
        folder: to write the model into, in COLMAP's binary files; made.

    Returns:
        Names of the photos whose poses were kept; nothing is written where most poses are contradicted.
    """
    with pycolmap.Database.open(database) as opened:
        model = pycolmap.Reconstruction()
        model.load(pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions()))
        known = {n: pycolmap.Rigid3d(np.asarray(poses[i.name])) for n, i in model.images.items() if i.name in poses}
        kept = _agreeing(opened, model, known)
    if len(kept) < max(2, MIN_AGREEING * len(known)):
        return set()
    for image in map(model.image, kept):
        assert image.frame is not None
        image.frame.set_cam_from_world(image.camera_id, known[image.image_id])
        model.register_frame(image.frame_id)
    names = {model.image(number).name for number in kept}
    folder.mkdir(exist_ok=True)
    pycolmap.triangulate_points(model, database, images, folder)
    return names


def epipolar_errors(
    model: pycolmap.Reconstruction,
    photos: tuple[int, int],
    matches: np.ndarray,
    poses: Mapping[int, pycolmap.Rigid3d],
) -> np.ndarray:
    """How far matches [N, 2] of two photos are from the epipolar lines of their poses, pixels [N].

    Args:
        model: the photos and cameras.
        photos: their numbers.
        matches: numbers of the features that match.
        poses: camera from world, by the number of the photo.
    """
    cameras = [model.cameras[model.image(number).camera_id] for number in photos]
    here, there = (
        camera.cam_from_img(np.array([model.image(number).points2D[at].xy for at in chosen]))
        for number, camera, chosen in zip(photos, cameras, matches.T, strict=True)
    )
    essential = pycolmap.essential_matrix_from_pose(poses[photos[1]] * poses[photos[0]].inverse())
    errors = np.sqrt(pycolmap.compute_squared_sampson_error(here, there, essential))
    return errors * np.mean([camera.mean_focal_length() for camera in cameras])


def _agreeing(
    database: pycolmap.Database, model: pycolmap.Reconstruction, poses: Mapping[int, pycolmap.Rigid3d]
) -> list[int]:
    """The photos most of whose matches lie on the epipolar lines of their poses; the worst is left out by turns.

    A photo without matches has nothing to say for its pose.

    Args:
        database: of features and matches.
        model: the photos and cameras of the database.
        poses: camera from world, by the number of the photo.
    """
    numbers = sorted(poses)
    place = {number: at for at, number in enumerate(numbers)}
    matches, agreeing = np.zeros((2, len(numbers), len(numbers)))
    ids, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(ids, geometries, strict=True):
        both = pycolmap.pair_id_to_image_pair(pair)
        if not len(geometry.inlier_matches) or any(number not in place for number in both):
            continue
        errors = epipolar_errors(model, both, geometry.inlier_matches, poses)
        at = (place[both[0]], place[both[1]])
        matches[at] = matches[at[::-1]] = len(errors)
        agreeing[at] = agreeing[at[::-1]] = (errors <= MAX_ERROR).sum()
    kept = np.ones(len(numbers), dtype=bool)
    while kept.any():
        share = agreeing[:, kept].sum(axis=1) / np.maximum(matches[:, kept].sum(axis=1), 1)
        worst = min(np.flatnonzero(kept), key=lambda number: share[number])
        if share[worst] >= MIN_AGREEING:
            break
        kept[worst] = False
    return [number for number, is_kept in zip(numbers, kept, strict=True) if is_kept]


def align(model: pycolmap.Reconstruction, poses: Mapping[str, np.ndarray]) -> None:
    """Move and scale a model to where its photos were before.

    The rotation comes from the photos' directions: centers on a line, as of a walk, would leave it undetermined.

    Args:
        model: changed in place.
        poses: camera from world [3, 4] by the photo's name; two of them at least, not at one place.
    """
    images = [image for image in model.images.values() if image.has_pose and image.name in poses]
    old = np.array([poses[image.name] for image in images])
    new = np.array([image.cam_from_world().matrix() for image in images])
    u, _, v = np.linalg.svd(np.einsum("nji,njk->ik", old[:, :, :3], new[:, :, :3]))
    rotation = (u * [1, 1, np.linalg.det(u @ v)]) @ v
    there, here = (-np.einsum("nji,nj->ni", each[:, :, :3], each[:, :, 3]) for each in (old, new))
    scale = np.linalg.norm(there - there.mean(axis=0)) / np.linalg.norm(here - here.mean(axis=0))
    moved = np.column_stack([scale * rotation, there.mean(axis=0) - scale * rotation @ here.mean(axis=0)])
    model.transform(pycolmap.Sim3d(moved))
