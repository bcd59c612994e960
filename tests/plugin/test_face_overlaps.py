"""Overlays of faces of a panorama: one artifact where the faces overlap, from the start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssa_nerfstudio.cameras.panorama import cut, panorama_faces
from ssa_nerfstudio.data.panorama_entry import Panorama
from ssa_nerfstudio.evidence.initialization import initialize_as
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.face_overlaps import faces_of, joined_overlays

WIDTH = 512
FACES = panorama_faces(WIDTH)
COLOR = 0.25


def operator_below(highest: float, face_name: str) -> torch.Tensor:
    """Layers [size, size, 4] of a face, opaque below a latitude in degrees."""
    height = WIDTH // 2
    latitude = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * 180
    hidden = np.broadcast_to(latitude < highest, (height, WIDTH)).astype(np.float32)
    layers = np.stack([1 - hidden, *[COLOR * hidden] * 3], axis=-1)
    (face,) = [each for each in FACES if each.name == face_name]
    return torch.from_numpy(cut(layers, face))


def overlay_of(layers: torch.Tensor) -> ScreenSpaceOverlay:
    overlay = ScreenSpaceOverlay(*layers.shape[:2])
    initialize_as(overlay, layers)
    return overlay


def test_what_reaches_over_the_border_of_a_face_starts_in_its_neighbors():
    overlays = [overlay_of(operator_below(-44.0, "down")) if face.name == "down" else None for face in FACES]
    joined = joined_overlays(FACES, overlays, 1)
    assert {FACES[number].name for number in joined} == {"front", "right", "back", "left"}
    for number, overlay in joined.items():
        transmittance, addition = (layer.detach() for layer in overlay.layers())
        truth = operator_below(-44.0, FACES[number].name)
        hidden, clear = truth[..., 0] < 0.1, truth[..., 0] > 0.9
        assert hidden.any()
        assert transmittance[hidden].mean() < 0.1
        assert addition[hidden].mean() == pytest.approx(COLOR, abs=0.03)
        assert transmittance[clear].mean() > 0.98


@pytest.mark.parametrize("highest", [-60.0, -90.0], ids=["inside of its face", "nowhere"])
def test_what_stays_inside_of_its_face_is_no_matter_of_others(highest):
    overlays = [overlay_of(operator_below(highest, "down")) if face.name == "down" else None for face in FACES]
    assert joined_overlays(FACES, overlays, 1) == {}


def test_faces_that_agree_are_left_as_they_are():
    overlays = [overlay_of(operator_below(-40.0, face.name)) for face in FACES]
    assert joined_overlays(FACES, overlays, 1) == {}


def test_cameras_are_known_as_faces_by_their_focal_lengths():
    panorama = Panorama(WIDTH, FACES[1:])
    size = FACES[0].size // 2
    keys = torch.tensor([[size, size, face.focal / 2, face.focal / 2, size / 2, size / 2] for face in FACES[:0:-1]])
    found = faces_of(panorama, keys)
    assert found == [replace(face, size=size) for face in FACES[:0:-1]]
    assert faces_of(panorama, torch.cat([keys, keys[:1]])) is None, "two cameras of one face"
    keys[0, :2] += 2
    assert faces_of(panorama, keys) is None, "another size"
