"""Additive light: whether an artifact hides the scene shows in the deviation of the views across its edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.evidence.additive_light import MIN_EDGES, adds_light
from ssa_nerfstudio.evidence.detection import static_area
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate

HEIGHT, WIDTH, VIEWS = 96, 128, 24


def scene(rng: np.random.Generator, views: int = VIEWS) -> np.ndarray:
    """Views [V, H, W, 3] in [0, 0.7] that share nothing, with structure of all sizes."""
    layers = [cv2.resize(rng.random((views, 3, size, size)).transpose(2, 3, 0, 1).reshape(size, size, -1)[..., :500],
                         (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for size in (4, 16, 64)]  # fmt: skip
    mixed = np.mean(layers, axis=0)
    return mixed.reshape(HEIGHT, WIDTH, views, 3).transpose(2, 0, 1, 3).clip(0, 1) * 0.7


def drops(rng: np.random.Generator) -> np.ndarray:
    """Blobs all over the frame, [H, W, 1] in [0, 1]."""
    noise = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH)), (0, 0), 2)
    return np.clip(noise / noise.std() - 0.5, 0, 1)[..., None]


def statistics_of(photos: np.ndarray) -> ImageStatistics:
    return accumulate((torch.from_numpy((photo * 255).round().astype(np.uint8)), None) for photo in photos)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("transmitted", "added"), [(0.3, 0.1), (0.5, 0.3), (0.6, 0.0), (0.2, 0.7)])
def test_an_artifact_that_lowers_the_deviation_hides(transmitted: float, added: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    photos, matte = scene(rng), drops(rng)
    area = static_area(statistics_of((1 - matte * (1 - transmitted)) * photos + matte * added))
    assert area.inside.any()
    assert not area.adds_light


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("strength", [0.1, 0.2, 0.3])
def test_an_artifact_that_keeps_the_deviation_adds_light(strength: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    photos, light = scene(rng), drops(rng)
    area = static_area(statistics_of(photos + strength * light * np.array([1.0, 0.9, 0.7])))
    assert area.inside.any()
    assert area.adds_light


def test_an_opaque_board_hides_although_the_deviation_on_it_has_no_edges() -> None:
    rng = np.random.default_rng(0)
    photos = scene(rng)
    photos[:, 60:] = rng.random((HEIGHT - 60, WIDTH, 3))
    area = static_area(statistics_of(photos))
    assert area.inside[64:].all()
    assert not area.adds_light


def test_a_board_together_with_light_counts_as_light() -> None:
    """A layer that adds light can hide, too: with it both can be learned."""
    rng = np.random.default_rng(1)
    photos = scene(rng) + 0.3 * drops(rng)
    photos[:, 80:] = 0.2
    assert static_area(statistics_of(photos)).adds_light


def test_near_pixels_surround_static_edges() -> None:
    photos = scene(np.random.default_rng(2))
    photos[:, 80:, :40] = 0.1
    area = static_area(statistics_of(photos))
    assert (area.near | ~area.inside).all(), "what is inside is near"
    assert area.near[70:, :50].all()
    assert not area.near[:50].any()
    assert not area.near[:, 80:].any()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), gain=st.floats(0.05, 1.0), turns=st.integers(0, 3))
def test_the_result_depends_neither_on_exposure_nor_on_orientation(seed: int, gain: float, turns: int) -> None:
    rng = np.random.default_rng(seed)
    mean, deviation = rng.random((20, 30)), 0.02 + rng.random((20, 30))
    deviation = cv2.GaussianBlur(deviation, (0, 0), 2) * 20
    edges = rng.random((20, 30)) < 0.5
    expected = adds_light(mean, deviation, edges)
    turned = (np.rot90(layer, turns) for layer in (gain * mean, deviation, edges))
    assert adds_light(*turned) == expected


def test_too_few_edges_count_as_hiding() -> None:
    edges = np.zeros((20, 30), bool)
    edges.flat[: MIN_EDGES - 1] = True
    assert not adds_light(np.eye(20, 30), np.ones((20, 30)), edges)
