"""Faces of equirectangular photos: where they look, that they fit together, and that training tells them apart."""

from __future__ import annotations

import numpy as np
import pytest

from ssa_nerfstudio.cameras.groups import group_frames
from ssa_nerfstudio.cameras.panorama import FACE_NAMES, compose, cut, hidden_by_neighbors, panorama_faces

WIDTH = 256
LOOKS = {
    "front": (0, 0, 1),
    "right": (1, 0, 0),
    "back": (0, 0, -1),
    "left": (-1, 0, 0),
    "up": (0, -1, 0),
    "down": (0, 1, 0),
}


def directions(width: int) -> np.ndarray:
    """Direction of each pixel of a panorama, [width / 2, width, 3], from its definition."""
    longitude = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    latitude = np.pi * (0.5 - (np.arange(width // 2)[:, None] + 0.5) / (width // 2))
    x, y, z = np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1).astype(np.float32)


@pytest.mark.parametrize("face", panorama_faces(WIDTH), ids=lambda face: face.name)
def test_a_face_shows_the_directions_of_its_camera(face):
    """A panorama whose colors are its directions: a face's pixels have the directions of their rays."""
    seen = cut(directions(WIDTH), face)
    axis = (np.arange(face.size) + 0.5 - face.size / 2) / face.focal
    x, y = np.meshgrid(axis, axis)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    assert np.abs(seen - rays @ face.from_panorama).max() < 0.02
    middle = seen[face.size // 2 - 1 : face.size // 2 + 1, face.size // 2 - 1 : face.size // 2 + 1].mean(axis=(0, 1))
    assert middle == pytest.approx(LOOKS[face.name], abs=0.01)
    assert np.linalg.det(face.from_panorama) == pytest.approx(1)


def test_faces_fit_together_without_a_seam():
    faces = panorama_faces(WIDTH)
    whole, known = compose([(face, cut(directions(WIDTH), face)) for face in faces], WIDTH)
    assert known.all()
    assert np.abs(whole - directions(WIDTH)).max() < 0.03
    ones, _ = compose([(face, np.ones((face.size, face.size, 1), np.float32)) for face in faces], WIDTH)
    assert np.abs(ones - 1).max() < 1e-5


def test_where_faces_disagree_the_step_at_the_seam_is_spread():
    faces = panorama_faces(4 * WIDTH)
    gray = [(face, np.full((face.size, face.size, 1), number / 5, np.float32)) for number, face in enumerate(faces)]
    row = compose(gray, 4 * WIDTH)[0][WIDTH, :, 0]
    assert np.ptp(row) == pytest.approx(0.6), "the four faces along the horizon"
    assert np.abs(np.diff(row, append=row[0])).max() < 0.15


def test_what_no_face_sees_is_not_known():
    faces = panorama_faces(WIDTH, left_out=("down",))
    assert [face.name for face in faces] == [name for name in FACE_NAMES if name != "down"]
    whole, known = compose([(face, np.ones((face.size, face.size, 1), np.float32)) for face in faces], WIDTH)
    assert not known[-1].any()
    assert known[: WIDTH // 4].all()
    assert (whole[..., 0] == known).all()


def test_each_face_is_a_camera_of_its_own_and_a_pixel_is_about_one_of_the_panorama():
    for width in (128, 512, 5760):
        faces = panorama_faces(width)
        frames = [[f.size, f.size, f.focal, f.focal, f.size / 2, f.size / 2] for f in faces for _ in range(2)]
        assert group_frames(np.array(frames)) == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
        # Also at an eighth of the size.
        assert max(group_frames(np.array(frames) / 8)) == 5
        assert faces[0].focal == pytest.approx(width / (2 * np.pi), rel=0.05)


@pytest.mark.parametrize("face", panorama_faces(WIDTH), ids=lambda face: face.name)
def test_neighbors_know_what_hides_the_scene_at_a_faces_border(face):
    """Layers on the sphere, opaque around one corner where three faces meet, cut into all faces."""
    near = directions(WIDTH) @ (np.array([1, 1, -1]) / np.sqrt(3))  # right, down and back
    transmittance = 1 - 1 / (1 + np.exp(-(near - 0.9) / 0.02))
    layers = np.stack([transmittance, *[0.5 * (1 - transmittance)] * 3], axis=-1).astype(np.float32)
    faces = panorama_faces(WIDTH)
    own = {each.name: cut(layers, each) for each in faces}
    found = hidden_by_neighbors(face, [(each, own[each.name]) for each in faces if each != face])
    hidden = found[..., 0] < 0.5
    assert hidden.any() == (face.name in ("right", "down", "back"))
    assert np.abs(found - own[face.name])[hidden].max(initial=0) < 0.15
    assert hidden.mean() < 0.05, "within the overlap alone, two degrees along each border"
    assert (found[len(found) // 2, len(found) // 2] == [1, 0, 0, 0]).all()
