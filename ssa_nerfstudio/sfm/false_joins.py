"""Places that look alike, where mapping has joined photos wrongly: found, and joined again.

Repeated textures and objects match as if they were one. Each such pair of photos has few matches, but there may be more
of these pairs than of true ones, and mapping, which goes by the number, puts a part of the photos at the wrong place.
All matches that it has used agree then. The two photos with the most matches show nearly the same view, one after the
other, so the strongest links that connect all photos (a maximum spanning tree of the numbers of matches) are the
ones to trust. A wrong join tears one of them: its photos see the same things at different places.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from ssa_nerfstudio.sfm.known_poses import MAX_ERROR, MIN_AGREEING, epipolar_errors

_MIN_MATCHES = 15
"""Matches that say something: what COLMAP asks of a pair of photos."""


@dataclass(frozen=True, eq=False)
class _Link:
    """Two photos that match."""

    photos: tuple[int, int]
    """Their numbers."""
    matches: np.ndarray
    """Numbers of the features [N, 2] that match."""


def torn_links(database: Path, model: pycolmap.Reconstruction) -> list[tuple[str, str]]:
    """The photos whose link is among the strongest that connect the photos, and is contradicted by the model.

    Args:
        database: of features and matches.
        model: mapped from it.

    Returns:
        Names of both photos of each, in order.
    """
    points = _points(model)
    torn = [link for link in _tree(database, model) if _is_torn(link, model, points)]
    return sorted(tuple(sorted(model.image(number).name for number in link.photos)) for link in torn)  # type: ignore[misc]


def rejoin(database: Path, images: Path, model: pycolmap.Reconstruction, folder: Path) -> bool:
    """Cut the model at the torn links, put its parts where these have them, and triangulate all matches anew.

    Args:
        database: of features and matches.
        images: folder of the photos.
        model: mapped from it; not changed.
        folder: to write the model into, in COLMAP's binary files; made.

    Returns:
        Whether that was done: not where nothing is torn, or the matches of a torn link do not say where its parts are.
    """
    points, tree = _points(model), _tree(database, model)
    torn = [link for link in tree if _is_torn(link, model, points)]
    if not torn:
        return False
    part_of = _parts([link for link in tree if link not in torn], model)
    # Each part's pose in the world of the result; torn links and parts are trees, too.
    placed: dict[int, np.ndarray] = {}
    while torn:
        link = next((link for link in torn if any(part_of[frame] in placed for frame in _frames(link, model))), None)
        if link is None:  # photos without a link to those before stay where they are
            placed[part_of[_frames(torn[0], model)[0]]] = np.eye(4)
            continue
        torn.remove(link)
        if part_of[_frames(link, model)[0]] not in placed:
            link = _Link((link.photos[1], link.photos[0]), link.matches[:, ::-1])
        moved = _move(link, model, points)
        if moved is None:
            return False
        here, there = (part_of[frame] for frame in _frames(link, model))
        placed[there] = placed[here] @ moved
    result = pycolmap.Reconstruction(model)
    for frame in result.frames.values():
        if frame.has_pose():
            part = pycolmap.Sim3d(placed.get(part_of[frame.frame_id], np.eye(4))[:3])
            frame.rig_from_world = part.transform_camera_world(frame.rig_from_world)
    folder.mkdir()
    pycolmap.triangulate_points(result, database, images, folder)
    return True


def _parts(links: list[_Link], model: pycolmap.Reconstruction) -> dict[int, int]:
    """The number of the part to which each frame with a pose belongs, where links connect the frames of a part."""
    frames = [number for number, frame in model.frames.items() if frame.has_pose()]
    place = {frame: at for at, frame in enumerate(frames)}
    ends = np.array([[place[frame] for frame in _frames(link, model)] for link in links], dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), ends.T), shape=(len(frames), len(frames)))
    _, labels = connected_components(graph, directed=False)
    return dict(zip(frames, labels.tolist(), strict=True))


def _frames(link: _Link, model: pycolmap.Reconstruction) -> tuple[int, int]:
    one, other = (model.image(number).frame_id for number in link.photos)
    return one, other


def _tree(database: Path, model: pycolmap.Reconstruction) -> list[_Link]:
    """The strongest links that connect all photos that have poses, a rig's photos of one moment being one, in order."""
    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
    links = [
        _Link(pycolmap.pair_id_to_image_pair(pair), geometry.inlier_matches)
        for pair, geometry in zip(ids, geometries, strict=True)
    ]
    posed = {number for number, image in model.images.items() if image.has_pose}
    links = [link for link in links if len(link.matches) >= _MIN_MATCHES and posed.issuperset(link.photos)]
    # Of two frames of rigs the photos with the most matches; none of two photos of one frame.
    strongest = {frozenset(_frames(link, model)): link for link in sorted(links, key=lambda link: len(link.matches))}
    between = {tuple(sorted(frames)): link for frames, link in strongest.items() if len(frames) == 2}
    frames = np.unique(np.array([*between], dtype=np.int64))
    ends = np.searchsorted(frames, np.array([*between], dtype=np.int64).reshape(-1, 2))
    # Fewest are the least: a minimum spanning tree of the inverse numbers.
    costs = [1 / len(link.matches) for link in between.values()]
    tree = minimum_spanning_tree(coo_array((costs, ends.T), shape=(len(frames), len(frames)))).tocoo()
    links = [between[int(frames[i]), int(frames[j])] for i, j in zip(tree.row, tree.col, strict=True)]
    return sorted(links, key=lambda link: len(link.matches), reverse=True)


def _points(model: pycolmap.Reconstruction) -> dict[int, np.ndarray]:
    """The point that each feature of a photo observes, by the photo's number; -1 for none."""
    return {
        number: np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], dtype=np.int64)
        for number, image in model.images.items()
        if image.has_pose
    }


def _observed(link: _Link, points: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The points of the matches of which both features observe one."""
    one, other = (points[number][at] for number, at in zip(link.photos, link.matches.T, strict=True))
    both = (one >= 0) & (other >= 0)
    return one[both], other[both]


def _is_torn(link: _Link, model: pycolmap.Reconstruction, points: dict[int, np.ndarray]) -> bool:
    """Whether most matches observe different points or are off the epipolar lines.

    Measured: of true links at least 0.93 agree, of torn ones at most 0.46.
    """
    one, other = _observed(link, points)
    if len(one) >= _MIN_MATCHES and (one == other).mean() < MIN_AGREEING:
        return True
    poses = {number: model.image(number).cam_from_world() for number in link.photos}
    return (epipolar_errors(model, link.photos, link.matches, poses) <= MAX_ERROR).mean() < MIN_AGREEING


def _move(link: _Link, model: pycolmap.Reconstruction, points: dict[int, np.ndarray]) -> np.ndarray | None:
    """The similarity [4, 4] that puts points of the second photo where those of the first are that match.

    Matches that observe one point have been used for the wrong join, and say nothing.
    """
    one, other = _observed(link, points)
    differ = one != other
    if differ.sum() < _MIN_MATCHES:
        return None
    here, there = (np.array([model.point3D(at).xyz for at in each[differ]]) for each in (one, other))
    view = model.image(link.photos[0])
    depth = np.median((here - view.projection_center()) @ view.viewing_direction())
    options = pycolmap.RANSACOptions()
    options.random_seed = 0
    options.max_error = MAX_ERROR / model.cameras[view.camera_id].mean_focal_length() * max(float(depth), 1e-9)
    # A dictionary, which the type stubs of pycolmap 4.2 do not say.
    found: Any = pycolmap.estimate_sim3d_robust(there, here, options)
    if found is None or found["num_inliers"] < _MIN_MATCHES:
        return None
    return np.vstack([found["tgt_from_src"].matrix(), [0, 0, 0, 1]])
