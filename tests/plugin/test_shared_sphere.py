"""Overlays of a panorama's faces that are one artifact on the sphere while they are trained."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from PIL import Image

from ssa_nerfstudio.cameras.panorama import Face, owned_by_neighbors, panorama_faces
from ssa_nerfstudio.data.panorama_entry import panorama_entry
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.shared_sphere import EVERY, SharedSphere

WIDTH = 384
FACES = list(panorama_faces(WIDTH))


def directions_of(face: Face) -> np.ndarray:
    """Of a face's pixels in the panorama's axes, [size * size, 3]."""
    axis = (np.arange(face.size) + 0.5 - face.size / 2) / face.focal
    x, y = np.meshgrid(axis, axis)
    found = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ face.from_panorama
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def smooth(face: Face) -> tuple[torch.Tensor, torch.Tensor]:
    """Color and matte that are smooth on the sphere."""
    x, y, z = (torch.from_numpy(v).float().reshape(face.size, face.size, 1) for v in directions_of(face).T)
    return torch.cat([0.5 + 0.3 * x, 0.5 + 0.3 * y, 0.5 + 0.3 * z], dim=-1), 0.5 + 0.3 * x * y


def overlays(noise: float = 0.0, lit: tuple[str, ...] = ()) -> list[ScreenSpaceOverlay]:
    generator, made = torch.Generator().manual_seed(0), []
    for face in FACES:
        overlay = ScreenSpaceOverlay(face.size, face.size, adds_light=face.name in lit)
        overlay.initialize(*smooth(face), torch.ones(face.size, face.size, 1))
        for logits in overlay.parameters():
            logits.data += noise * torch.randn(logits.shape, generator=generator)
        made.append(overlay)
    return made


def layers(overlay: ScreenSpaceOverlay) -> np.ndarray:
    return torch.cat(overlay.layers(), dim=-1).detach().numpy()


@pytest.mark.parametrize("scale", [1, 2])
def test_every_direction_has_one_owner(scale):
    """A pixel that another face owns is where that one sees the same direction, and that one's own."""
    owned = {face: owned_by_neighbors(face, [f for f in FACES if f != face], scale) for face in FACES}
    for face, owners in owned.items():
        side = face.size // scale
        numbers = np.concatenate([pixels for _, pixels, _ in owners])
        assert 0 < len(numbers) < 0.2 * side**2
        assert len(np.unique(numbers)) == len(numbers)
        for owner, pixels, positions in owners:
            row, column = np.divmod(pixels, side)
            axis = [((each + 0.5) * scale - face.size / 2) / face.focal for each in (column, row)]
            wanted = np.stack([*axis, np.ones(len(pixels))], axis=-1) @ face.from_panorama
            seen = (positions * scale - owner.size / 2) / owner.focal
            there = np.concatenate([seen, np.ones((len(seen), 1))], axis=-1) @ owner.from_panorama
            lengths = np.linalg.norm(wanted, axis=-1) * np.linalg.norm(there, axis=-1)
            np.testing.assert_allclose((wanted * there).sum(axis=-1) / lengths, 1, atol=1e-9)
            assert (np.abs(seen).max(axis=-1) <= 1 + 1e-9).all(), "in the middle 90 degrees of its owner"


def test_what_agrees_stays_as_it_is():
    before, after = overlays(), overlays()
    SharedSphere(FACES, after).share()
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(layers(b), layers(a), atol=2e-3)


def test_faces_that_were_trained_apart_agree_where_they_overlap():
    apart, shared = overlays(noise=0.5), overlays(noise=0.5)
    sphere = SharedSphere(FACES, shared)
    sphere.share()
    for number, face in enumerate(FACES):
        copied = np.zeros(face.size**2, bool)
        for owner, pixels, positions in owned_by_neighbors(face, [f for f in FACES if f != face]):
            copied[pixels] = True
            column, row = np.floor(positions).astype(int).T
            inner = (np.abs(positions - positions.round()) > 0.4).all(axis=-1)  # near the middle of an owner's pixel
            if inner.any():
                theirs = layers(apart[FACES.index(owner)])[row[inner], column[inner]]
                own = layers(apart[number]).reshape(-1, 4)[pixels[inner]]
                found = layers(shared[number]).reshape(-1, 4)[pixels[inner]]
                assert np.abs(found - theirs).mean() < 0.5 * np.abs(own - theirs).mean()
        untouched = layers(shared[number]).reshape(-1, 4)[~copied]
        np.testing.assert_array_equal(untouched, layers(apart[number]).reshape(-1, 4)[~copied])


def test_sharing_again_and_again_blurs_nothing():
    """What is learned never changes, and of what repeats it only what lies between two owners, a little."""
    made = overlays(noise=0.5)
    learned = [layers(overlay).reshape(-1, 4) for overlay in made]
    sphere = SharedSphere(FACES, made)
    sphere.share()
    first = [layers(overlay).reshape(-1, 4) for overlay in made]
    for _ in range(50):
        sphere.share()
    for number, face in enumerate(FACES):
        copied = np.zeros(face.size**2, bool)
        for _, pixels, _ in owned_by_neighbors(face, [f for f in FACES if f != face]):
            copied[pixels] = True
        last = layers(made[number]).reshape(-1, 4)
        np.testing.assert_array_equal(last[~copied], learned[number][~copied])
        assert np.abs(last - first[number])[copied].mean() < 0.03


def test_added_light_goes_over_borders_as_far_as_a_matte_can_hold_it():
    """B <= A where the neighbor adds no light."""
    made = overlays(lit=("down",))
    SharedSphere(FACES, made).share()
    compared = 0
    for face, overlay in zip(FACES, made, strict=True):
        for owner, pixels, _ in owned_by_neighbors(face, [f for f in FACES if f != face]):
            if owner.name == "down":
                transmittance, added = np.split(layers(overlay).reshape(-1, 4)[pixels], [1], axis=-1)
                light, matte = (each.reshape(-1, each.shape[-1]).numpy()[pixels] for each in smooth(face))
                np.testing.assert_allclose(1 - transmittance, matte, atol=5e-3)
                np.testing.assert_allclose(added, np.minimum(light, matte), atol=5e-3)
                compared += len(pixels)
    assert compared > 100


@pytest.fixture(scope="module")
def two_faces(tiny_scene, tmp_path_factory) -> Path:
    """A capture of two of a panorama's faces."""
    data = tmp_path_factory.mktemp("two") / "faces"
    shutil.copytree(tiny_scene, data)
    content = json.loads((data / "transforms.json").read_text())
    size = 48
    for number, frame in enumerate(content["frames"]):
        name = "front" if number % 2 else "right"
        path = data / frame["file_path"]
        Image.open(path).crop((0, 0, size, size)).save(path)
        focal = Face(name, size).focal
        frame |= {"w": size, "h": size, "fl_x": focal, "fl_y": focal, "cx": size / 2, "cy": size / 2}
    for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
        content.pop(key, None)
    content |= panorama_entry(2 * size, [Face("front", size), Face("right", size)])
    (data / "transforms.json").write_text(json.dumps(content))
    return data


@pytest.fixture(scope="module")
def trainer_of(configure_training) -> Callable[..., Any]:
    """A trainer that has been set up, given the folder of its run, the scene and the checkpoints to resume from."""

    def set_up(folder: Path, scene: Path, resumed: Path | None = None):
        config = configure_training("ssa-splatfacto", scene, folder, 20, {"overlay": "on", "num_downscales": 0})
        config.load_dir = resumed
        config.set_timestamp()
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer

    return set_up


def test_a_training_of_faces_shares_and_others_do_not(tmp_path, two_faces, tiny_scene, trainer_of, monkeypatch):
    """The overlays are apart before the step."""
    trainer = trainer_of(tmp_path / "a", two_faces)
    shared = []
    monkeypatch.setattr(SharedSphere, "share", lambda self: shared.append(self))
    attributes = TrainingCallbackAttributes(trainer.optimizers, trainer.grad_scaler, trainer.pipeline, trainer)
    for step in range(2 * EVERY):
        for callback in trainer.pipeline.get_training_callbacks(attributes)[-1:]:
            callback.run_callback(step)
    assert shared == [trainer.pipeline.sphere] * 2
    assert trainer_of(tmp_path / "b", tiny_scene).pipeline.sphere is None


def test_a_resumed_training_of_faces_shares_as_the_first_one_did(tmp_path, two_faces, trainer_of):
    """What a pixel repeats is the same in both, and it is the loaded overlays that do."""
    first = trainer_of(tmp_path / "first", two_faces)
    with torch.no_grad():
        for overlay in first.pipeline.model.artifacts.learned():
            overlay.alpha_logits.normal_()
    first.save_checkpoint(3)
    resumed = trainer_of(tmp_path / "resumed", two_faces, first.checkpoint_dir)
    assert resumed.pipeline.sphere is not None
    before, after = (each.pipeline.model.artifacts.learned() for each in (first, resumed))
    apart = [overlay.alpha_logits.clone() for overlay in after]
    for trainer in (first, resumed):
        trainer.pipeline.sphere.share()
    for a, b, unshared in zip(before, after, apart, strict=True):
        assert torch.equal(a.alpha_logits, b.alpha_logits)
        assert not torch.equal(b.alpha_logits, unshared)
