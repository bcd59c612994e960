"""The layers in the undistorted frame, where the training compares with them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from ssa_nerfstudio.cameras.lens import Lens, undistort
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS, effect_class
from ssa_nerfstudio.experiments.effects.composition import Composition
from ssa_nerfstudio.experiments.simulation.corruption import undistorted_layers

DEVIATION = {"rain": 16.0, "mud": 2.5}
"""Gray levels by which 99.9 % of all pixels deviate at most; 1.5 for the other effects."""


@pytest.mark.parametrize("effect", EFFECTS)
def test_undistorted_layers_form_the_undistorted_photo(effect, captures):
    """Bilinear averages of T C + B are not those of T and C; clipping comes before the warp in the photo."""
    meta = json.loads((captures / "gopro_walk/transforms.json").read_text())
    distortion = tuple(meta.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    lens = Lens(*(meta[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")), distortion=distortion)
    photo = np.asarray(Image.open(captures / "gopro_walk" / meta["frames"][0]["file_path"]))
    artifact = Composition([effect_class(effect)().layers(lens.height, lens.width, np.random.default_rng(0))])
    inside = None if artifact.box is None else artifact.view([np.random.default_rng(1)])
    seen = undistort(artifact.apply(photo, inside), lens)
    layers = undistorted_layers(artifact.whole(inside, lens.height, lens.width), lens)
    formed = (layers.transmittance * (undistort(photo, lens) / 255) + layers.addition).clip(0, 1) * 255
    deviation = np.abs(seen - formed)
    assert deviation.mean() < 0.5
    assert np.percentile(deviation, 99.9) < DEVIATION.get(effect, 1.5)
