"""Masks of a dataset that keep the artifact, or nothing."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
import torch
from PIL import Image
from small_captures import HEIGHT, WIDTH

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.mask_check import check_masks

NAMES = [f"images/{name}_{number:05d}.png" for name in ("front", "side") for number in range(24)]


def views(pictures: list[np.ndarray], masks: list[np.ndarray]) -> list[dict]:
    """As the datamanager caches them."""
    pairs = zip(pictures, masks, strict=True)
    return [{"image": torch.from_numpy(p), "mask": torch.from_numpy(m)[..., None]} for p, m in pairs]


def test_a_cameras_own_mask_is_compared_with_its_own_artifact(draw_effect, photos, caplog):
    """Two cameras: the first has a dashboard, and only its mask is wrong."""
    layers = draw_effect("dashboard", HEIGHT, WIDTH)
    there = layers.transmittance.min(axis=-1) <= 0.9
    pictures = [*(layers.apply(photo) for photo in photos(24)), *photos(24)]
    good = views(pictures, [~there] * 24 + [there] * 24)
    with caplog.at_level(logging.WARNING):
        check_masks(good, [0] * 24 + [1] * 24, NAMES)
    assert not caplog.records
    with pytest.raises(InputError, match=r"the mask of front keeps 2\d% .* artifact"):
        check_masks(views(pictures, [there] * 48), [0] * 24 + [1] * 24, NAMES)


def test_masks_that_keep_nearly_nothing(photos, caplog):
    """Where they differ they may be of a small object: a warning."""
    pictures = photos(8)
    nothing = np.zeros((HEIGHT, WIDTH), dtype=bool)
    with pytest.raises(InputError, match=r"the mask keeps 0.0% of the frame; invert the masks: black is ignored"):
        check_masks(views(pictures, [nothing] * 8), [0] * 8, NAMES[:8])
    different = [nothing.copy() for _ in pictures]
    for number, mask in enumerate(different):
        mask[number, : number + 1] = True
    with caplog.at_level(logging.WARNING):
        check_masks(views(pictures, different), [0] * 8, NAMES[:8])
    (record,) = caplog.records
    assert "keeps 0.0% of the frame" in record.message


def test_a_training_on_black_masks_is_refused(broken_scene, tmp_path, configure_training, train_and_evaluate):
    path = broken_scene / "transforms.json"
    meta = json.loads(path.read_text())
    for frame in meta["frames"]:
        with Image.open(broken_scene / frame["file_path"]) as photo:
            Image.new("L", photo.size, 0).save(broken_scene / "mask.png")
        frame["mask_path"] = "mask.png"
    path.write_text(json.dumps(meta))
    with pytest.raises(InputError, match="invert the masks"):
        train_and_evaluate(configure_training("ssa-splatfacto", broken_scene, tmp_path / "out", 2, {}))
