"""Overlays of faces of a panorama: one artifact where the faces overlap, from the start."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from ssa_nerfstudio.cameras.panorama import cut, panorama_faces
from ssa_nerfstudio.data.panorama_entry import Panorama
from ssa_nerfstudio.evidence.initialization import initialize_as
from ssa_nerfstudio.overlay.layer import OPTIONAL_BUFFERS, ScreenSpaceOverlay
from ssa_nerfstudio.plugin.face_overlaps import faces_of, joined_overlays
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.overlay_setup import learned_overlays

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
    overlay = ScreenSpaceOverlay(layers.shape[0], layers.shape[1])
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


def test_drops_on_a_face_add_light_beside_what_reaches_over_from_its_neighbor():
    size = FACES[0].size
    front = FACES.index(next(each for each in FACES if each.name == "front"))
    rain = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(size, size, 1)
    rain[::5, ::5, 1:] = 0.5
    own = ScreenSpaceOverlay(size, size, adds_light=True)
    initialize_as(own, rain)
    overlays = [own if face is FACES[front] else None for face in FACES]
    down = next(number for number, face in enumerate(FACES) if face.name == "down")
    overlays[down] = overlay_of(operator_below(-44.0, "down"))
    found = joined_overlays(FACES, overlays, 1)[front]
    transmittance, addition = (layer.detach() for layer in found.layers())
    hidden = operator_below(-44.0, "front")[..., 0] < 0.1
    assert transmittance[hidden].mean() < 0.1
    drops = torch.zeros(size, size, dtype=torch.bool)
    drops[::5, ::5] = True
    drops[size // 2 :] = False
    assert transmittance[drops].min() > 0.98
    assert (addition[drops] - 0.5).abs().max() < 0.01


def test_a_face_keeps_what_is_known_of_its_own_photos():
    """Noise, where its artifact changes, and its lens's falloff, which is no artifact on either side of a border."""
    size = FACES[0].size
    front, down = next(each for each in FACES if each.name == "front"), operator_below(-44.0, "down")
    box = slice(size // 2 - 10, size // 2 + 10)
    logo = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(size, size, 1)
    logo[box, box] = torch.tensor([0.0, 0.3, 0.2, 0.1])
    own, below = overlay_of(logo), overlay_of(down)
    own.noise.fill_(0.008)
    own.reliable = torch.ones(size, size, 1)
    own.reliable[box, box] = 0
    row = torch.linspace(0.4, 1.0, size)[:, None, None].expand(size, size, 1)
    own.falloff, below.falloff = row.clone(), row.flip(0)
    overlays = [{"front": own, "down": below}.get(face.name) for face in FACES]
    joined = joined_overlays(FACES, overlays, 1)
    number = FACES.index(front)
    found = joined[number]
    for name in OPTIONAL_BUFFERS:
        assert torch.equal(getattr(found, name), getattr(own, name))
    transmittance, addition = (layer.detach() for layer in found.layers())
    truth = operator_below(-44.0, "front")
    hidden, clear = truth[..., 0] < 0.1, (truth[..., 0] > 0.9) & (logo[..., 0] > 0.9)
    torch.testing.assert_close(transmittance[clear], row[clear], atol=0.02, rtol=0)
    assert (addition / row)[hidden].mean() == pytest.approx(COLOR, abs=0.03)
    torch.testing.assert_close((addition / row)[box, box], logo[box, box, 1:], atol=0.01, rtol=0)
    other = joined[next(n for n in joined if n != number)]
    assert [getattr(other, name).tolist() for name in OPTIONAL_BUFFERS] == [[[[1.0]]]] * 3, "nothing is known of it"
    assert {FACES[n].name for n in joined} == {"front", "right", "back", "left"}


def test_a_strip_too_small_to_be_found_gets_an_overlay_and_one_line(capsys):
    """Panoramas that vary in everything but an operator below: only the face that looks down has enough of him."""
    rng, views = np.random.default_rng(0), 12
    hidden = np.linspace(90, -90, WIDTH // 2)[:, None, None] < -44.0
    coat = (60 + 60 * (np.arange(WIDTH // 2) // 4 % 2))[:, None, None]
    photos, names, groups = [], [], []
    for view in range(views):
        scene = cv2.resize(rng.integers(0, 255, (32, 64, 3), np.uint8), (WIDTH, WIDTH // 2))
        panorama = np.where(hidden, coat, scene).astype(np.uint8)
        for group, face in enumerate(FACES):
            photos.append({"image": torch.from_numpy(cut(panorama, face))})
            names.append(f"images/frame_{face.name}_{view:05d}.png")
            groups.append(group)
    size = FACES[0].size
    cameras = Cameras(torch.eye(4)[:3].repeat(len(photos), 1, 1), 100.0, 100.0, size / 2, size / 2, size, size)
    config = SSASplatfactoModelConfig()
    learned = learned_overlays(config, photos, names, cameras, None, groups, [(size, size)] * 6, faces=list(FACES))
    assert {face.name for face, each in zip(FACES, learned, strict=True) if each.overlay is None} == {"up"}
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("--pipeline.model.overlay") == 6, "one line for each face"
    assert (
        "The artifact reaches into the photos of frame_left from the face beside them: training with an overlay. "
        "(--pipeline.model.overlay off trains without.)" in told
    )
    assert re.search(
        r"of frame_down have a static artifact \(opaque, at least in part, [\d.]+% of the undistorted frame\): ", told
    )
    assert "The photos of frame_up show no static artifact" in told
    alone = learned_overlays(config, photos, names, cameras, None, groups, [(size, size)] * 6)
    found = {face.name for face, each in zip(FACES, alone, strict=True) if each.overlay is not None}
    assert found < {"front", "right", "back", "left", "down"}, "by their own photos"
    assert "down" in found


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
