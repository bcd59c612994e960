"""Effects in front of one another, static and varying."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.experiments.effects.composition import Composition
from ssa_nerfstudio.experiments.effects.layers import Layers, VaryingLayers

HEIGHT, WIDTH = 12, 16


def random_layers(seed: int, height: int = HEIGHT, width: int = WIDTH) -> Layers:
    rng = np.random.default_rng(seed)
    return Layers(*rng.uniform(0, 1, (2, height, width, 3)).astype(np.float32))


def random_varying(seed: int) -> VaryingLayers:
    rng = np.random.default_rng(seed)
    (top, bottom), (left, right) = (np.sort(rng.choice(side + 1, 2, replace=False)) for side in (HEIGHT, WIDTH))
    box = slice(int(top), int(bottom)), slice(int(left), int(right))
    size = int(bottom - top), int(right - left)
    return VaryingLayers(box, lambda view: random_layers(int(view.integers(1000)), *size))


def pasted(varying: VaryingLayers, view: np.random.Generator) -> Layers:
    transmittance = np.ones((HEIGHT, WIDTH, 3), np.float32)
    addition = np.zeros_like(transmittance)
    inside = varying.view(view)
    transmittance[varying.box], addition[varying.box] = inside.transmittance, inside.addition
    return Layers(transmittance, addition)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 10**6)), min_size=1, max_size=5))
def test_any_stack_is_its_parts_applied_one_after_the_other(stack):
    parts = [random_varying(seed) if varies else random_layers(seed) for varies, seed in stack]
    artifact = Composition(parts)
    seeds = [seed for varies, seed in stack if varies]
    inside = artifact.view([np.random.default_rng(seed) for seed in seeds]) if seeds else None
    whole = artifact.whole(inside, HEIGHT, WIDTH)

    photo = np.random.default_rng(7).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    light = photo / 255
    for (_, seed), part in zip(stack, parts, strict=True):
        layers = part if isinstance(part, Layers) else pasted(part, np.random.default_rng(seed))
        light = layers.transmittance * light + layers.addition
    # float16 holds eleven bits of what varies.
    assert whole.transmittance * (photo / 255) + whole.addition == pytest.approx(light, abs=2e-3 * len(parts))
    assert np.array_equal(artifact.apply(photo, inside), whole.apply(photo))


def test_layers_of_a_view_survive_float16():
    artifact = Composition([random_layers(1), random_varying(2)])
    view = artifact.view([np.random.default_rng(3)])
    for values in (view.transmittance, view.addition):
        assert np.array_equal(values, values.astype(np.float16).astype(np.float32))


def test_light_is_clipped_once_at_the_end():
    bright = Layers(np.ones((1, 1, 3), np.float32), np.full((1, 1, 3), 0.8, np.float32))
    dim = Layers(np.full((1, 1, 3), 0.5, np.float32), np.zeros((1, 1, 3), np.float32))
    white = np.full((1, 1, 3), 255, np.uint8)
    assert (Composition([bright, dim]).apply(white, None) == round(255 * 0.9)).all()
    assert (Composition([dim, bright]).apply(white, None) == 255).all()


def test_static_stacks_have_no_view_of_their_own():
    artifact = Composition([random_layers(1)])
    assert artifact.box is None
    with pytest.raises(ValueError, match="no effect varies"):
        artifact.view([])
