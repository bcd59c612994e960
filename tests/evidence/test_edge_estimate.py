"""Layers of an artifact estimated from its edges."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.evidence.edge_estimate import MAX_DISTANCE, estimate_layers, opaque_areas, textured_areas

HEIGHT, WIDTH = 96, 128


def logo() -> np.ndarray:
    """A ring and a bar, bool [h, w]."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    radius = np.hypot(y - 40, x - 60)
    return ((radius < 25) & (radius > 12)) | ((abs(y - 80) < 5) & (abs(x - 64) < 40))


def seen(matte: np.ndarray, color: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean [3, h, w] and deviation of an uneven scene behind a matte, and the matte's edges."""
    rng = np.random.default_rng(seed)
    scene, spread = (cv2.GaussianBlur(rng.random((HEIGHT, WIDTH)), (0, 0), 12) for _ in range(2))
    scene, spread = (0.2 + 0.4 * (s - s.min()) / np.ptp(s) for s in (scene, spread))
    outline = cv2.dilate((matte > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > (matte > 0)
    mean = (1 - matte) * scene + matte * color
    return np.stack([mean] * 3), (1 - matte) * spread / 3, outline.astype(np.uint8)


@pytest.mark.parametrize("alpha", [0.2, 0.4, 0.7])
def test_matte_and_difference_of_a_logo_are_estimated_from_its_outline(alpha: float) -> None:
    """The unknown scene behind varies slowly: the estimate keeps half of the logo, and drops the scene."""
    matte = alpha * logo()
    mean, deviation, edges = seen(matte, color=1.0)
    found = estimate_layers(mean, deviation, edges, 0 * edges)
    clean = seen(0 * matte, color=1.0)[0]
    inside, outside = logo() & (edges == 0), ~logo() & (edges == 0)
    assert 0.4 * alpha < np.median(found.matte[inside]) < 1.05 * alpha
    assert np.median(found.matte[outside]) < 0.03
    truth = (mean - clean)[0]
    assert 0.4 < np.median(found.difference[0][inside] / truth[inside]) < 1.05
    assert (found.matte[outside] > 0).mean() < 0.15


def test_without_static_edges_the_estimate_is_zero() -> None:
    """A sky above a skyline: mean and deviation have a border there, but no static edge."""
    mean, deviation, edges = seen(0.4 * logo(), color=1.0)
    mean[:, :10], deviation[:10] = 0.9, 0.001
    found = estimate_layers(mean, deviation, edges, 0 * edges)
    assert not found.matte[:9].any()
    assert not found.difference[:, :9].any()


def test_areas_are_opaque_where_the_deviation_rises_at_their_outline() -> None:
    """A board behind which nothing shows; a path that stays in place, ending in drops of mud."""
    deviation = np.full((HEIGHT, WIDTH), 0.2)
    board, path = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    board[70:], path[:40, 30:60] = 1, 1
    deviation[70:] = 0.002
    soft = cv2.GaussianBlur(path.astype(float), (0, 0), 8)
    deviation *= 1 - 0.95 * soft
    found = opaque_areas(board | path, deviation)
    assert found[70:].all()
    assert not found[:60].any()
    assert opaque_areas(np.ones_like(board), 0 * deviation).all(), "an area without surroundings counts as opaque"


def test_an_opaque_board_leaks_nothing_through_a_gap_in_its_outline() -> None:
    matte = np.zeros((HEIGHT, WIDTH))
    matte[70:] = 1
    mean, deviation, edges = seen(matte, color=0.1)
    edges[:, 50:60] = 0
    assert estimate_layers(mean, deviation, edges, 0 * edges).matte[:60].any()
    found = estimate_layers(mean, deviation, edges, opaque_areas((matte > 0).astype(np.uint8), deviation))
    assert not found.matte.any()
    assert not found.difference.any()


@settings(max_examples=25, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), seed=st.integers(0, 100))
def test_any_frame_gives_finite_layers_of_its_size(height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, deviation = rng.random((3, height, width)), 0.5 * rng.random((height, width))
    edges = (rng.random((height, width)) < 0.2).astype(np.uint8)
    found = estimate_layers(mean, deviation, edges, 0 * edges)
    assert found.matte.shape == (height, width)
    assert found.difference.shape == (3, height, width)
    assert np.isfinite(found.difference).all()
    assert found.matte.min() >= 0
    assert found.matte.max() <= 1
    assert opaque_areas(edges, deviation).shape == (height, width)
    empty = estimate_layers(mean, deviation, 0 * edges, edges)
    assert not empty.matte.any()
    assert not empty.difference.any()


def test_far_from_edges_the_estimate_is_zero_although_it_leaks() -> None:
    """The logo's outline is open at the right, where the integral continues."""
    matte = 0.6 * logo()
    mean, deviation, edges = seen(matte, color=1.0)
    wide = 3 * WIDTH
    mean, deviation = (
        np.pad(layer, (*[(0, 0)] * (layer.ndim - 1), (0, wide)), mode="edge") for layer in (mean, deviation)
    )
    edges = np.pad(edges, ((0, 0), (0, wide)))
    edges[:, 70:] = 0
    found = estimate_layers(mean, deviation, edges, 0 * edges)
    assert not found.matte[:, 70 + MAX_DISTANCE + 2 :].any()
    assert not found.difference[:, :, 70 + MAX_DISTANCE + 2 :].any()
    assert found.matte[:, :70].any()


def test_textured_areas_have_dense_edges_and_low_deviation() -> None:
    """A bonnet below; an equally dense texture above, where the scene changes behind it."""
    rng = np.random.default_rng(4)
    edges = np.zeros((HEIGHT, WIDTH), np.uint8)
    edges[80:], edges[:20] = rng.random((16, WIDTH)) < 0.4, rng.random((20, WIDTH)) < 0.4
    deviation = np.full((HEIGHT, WIDTH), 0.2)
    deviation[78:] = 0.05
    found = textured_areas(edges, deviation)
    assert found[82:].mean() > 0.95
    assert not found[:70].any()
