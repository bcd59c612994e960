"""The image formation of an effect, and the two effects that the demo uses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ssa_nerfstudio.experiments.effects.dashboard import Dashboard
from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.effects.watermark import Watermark

SIZES = [(112, 160), (113, 161), (240, 160), (37, 300), (7, 5), (2, 3), (1, 1), (1, 50), (50, 1)]


def random_image(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)


def constant_layers(transmittance: float, addition: float, height: int = 4, width: int = 6) -> Layers:
    shape = (height, width, 3)
    return Layers(np.full(shape, transmittance, np.float32), np.full(shape, addition, np.float32))


def test_apply_is_the_formation_rounded_to_nearest() -> None:
    rng = np.random.default_rng(1)
    transmittance, addition = rng.uniform(0, 1, (2, 40, 50, 3)).astype(np.float32)
    image = random_image(40, 50)
    exact = np.clip(transmittance.astype(np.float64) * image / 255 + addition, 0, 1) * 255
    formed = Layers(transmittance, addition).apply(image)
    assert formed.dtype == np.uint8
    assert np.abs(formed - exact).max() <= 0.5 + 1e-4


def test_apply_at_the_ends_of_the_range() -> None:
    image = random_image(4, 6)
    assert np.array_equal(constant_layers(1, 0).apply(image), image)
    assert (constant_layers(0, 0).apply(image) == 0).all()
    assert (constant_layers(0, 1).apply(image) == 255).all()
    assert (constant_layers(1, 7).apply(image) == 255).all()
    assert (constant_layers(0, 100 / 255).apply(image) == 100).all()


def test_identity_holds_for_every_level() -> None:
    image = np.repeat(np.arange(256, dtype=np.uint8), 3).reshape(16, 16, 3)
    assert np.array_equal(constant_layers(1, 0, 16, 16).apply(image), image)


def test_matte_is_what_the_channels_lose_on_average() -> None:
    transmittance = np.broadcast_to(np.array([1.0, 0.4, 0.1], np.float32), (2, 3, 3))
    layers = Layers(transmittance, np.zeros((2, 3, 3), np.float32))
    assert layers.matte.shape == (2, 3)
    assert layers.matte == pytest.approx(np.full((2, 3), 0.5), abs=1e-6)


@pytest.mark.parametrize("image", [random_image(4, 5), random_image(4, 6)[..., :1], random_image(4, 6) / 255])
def test_apply_refuses_other_images(image: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"image must be uint8 \[4, 6, 3\]"):
        constant_layers(1, 0).apply(image)


@pytest.mark.parametrize(
    ("transmittance", "addition", "message"),
    [
        (np.full((2, 2, 3), 1.5, np.float32), np.zeros((2, 2, 3), np.float32), r"transmittance must be finite and in"),
        (np.zeros((2, 2, 3), np.float32), np.full((2, 2, 3), -1, np.float32), r"addition must be finite and in"),
        (np.full((2, 2, 3), np.nan, np.float32), np.zeros((2, 2, 3), np.float32), r"transmittance must be finite"),
        (np.zeros((2, 2, 3)), np.zeros((2, 2, 3), np.float32), r"transmittance must be float32"),
        (np.zeros((2, 2, 3), np.float32), np.zeros((2, 2), np.float32), r"addition must be float32 \[H, W, 3\]"),
        (np.zeros((2, 2, 3), np.float32), np.zeros((2, 4, 3), np.float32), r"differ"),
    ],
)
def test_layers_refuse_bad_arrays(transmittance: np.ndarray, addition: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Layers(transmittance, addition)


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("effect", [Dashboard(), Watermark()])
def test_any_frame_size(effect: Dashboard | Watermark, height: int, width: int) -> None:
    """`Layers` itself checks shapes, types and ranges."""
    layers = effect.layers(height, width, np.random.default_rng(0))
    assert layers.matte.shape == (height, width)
    assert (layers.addition <= 1).all()
    assert layers.apply(random_image(height, width)).shape == (height, width, 3)


@pytest.mark.parametrize("effect", [Dashboard(), Watermark()])
def test_effects_are_deterministic_in_the_generator(effect: Dashboard | Watermark) -> None:
    first, second = (effect.layers(112, 160, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.transmittance, second.transmittance)
    assert np.array_equal(first.addition, second.addition)


def test_dashboard_grain_and_needles_follow_the_generator() -> None:
    first, second = (Dashboard().layers(112, 160, np.random.default_rng(seed)) for seed in (0, 1))
    assert np.array_equal(first.matte, second.matte)
    assert not np.array_equal(first.addition, second.addition)


def test_dashboard_is_opaque_below_and_absent_above() -> None:
    layers = Dashboard().layers(112, 160, np.random.default_rng(0))
    rows = np.flatnonzero(layers.matte.any(axis=1))
    assert rows.min() >= np.floor(112 * (1 - 0.32))
    assert (layers.transmittance[-10:] == 0).all()
    assert 0.2 < layers.matte.mean() < 0.32

    image = random_image(112, 160)
    formed = layers.apply(image)
    assert np.array_equal(formed[:56], image[:56])
    assert np.array_equal(formed[-10:], layers.apply(255 - image)[-10:])


def test_dashboard_height_and_softness_mean_what_they_say() -> None:
    def partly_covered(softness: float) -> float:
        matte = Dashboard(height=0.5, softness=softness).layers(200, 300, np.random.default_rng(0)).matte
        assert not matte[:100].any()
        return ((matte > 0) & (matte < 1)).sum(axis=0).mean()

    assert partly_covered(1.0) == pytest.approx(1, abs=0.2)
    assert partly_covered(8.0) == pytest.approx(8, abs=0.5)


def test_watermark_has_its_alpha_at_the_center_and_leaves_the_corners() -> None:
    layers = Watermark().layers(112, 160, np.random.default_rng(0))
    assert layers.transmittance[56, 80] == pytest.approx([0.6] * 3, abs=1e-7)
    assert layers.addition[56, 80] == pytest.approx([0.4] * 3, abs=1e-7)
    assert layers.matte.max() == pytest.approx(0.4, abs=1e-6)
    for corner in (np.s_[:20, :20], np.s_[:20, -20:], np.s_[-10:, :20], np.s_[-10:, -20:]):
        assert not layers.matte[corner].any()


def test_watermark_size_is_the_width_of_its_text() -> None:
    matte = Watermark(size=0.5, alpha=1.0).layers(600, 800, np.random.default_rng(0)).matte
    columns = np.flatnonzero(matte.any(axis=0))
    assert np.ptp(columns) == pytest.approx(400, rel=0.03)
    assert columns.mean() == pytest.approx(400, abs=4)


def test_watermark_color() -> None:
    layers = Watermark(alpha=0.5, color=(255, 0, 51)).layers(60, 90, np.random.default_rng(0))
    assert layers.addition[30, 45] == pytest.approx([0.5, 0.0, 0.1], abs=1e-6)


@pytest.mark.parametrize(
    ("effect", "field", "value"),
    [
        (Dashboard, "height", 0.0),
        (Dashboard, "height", 0.51),
        (Dashboard, "height", float("nan")),
        (Dashboard, "softness", 0.0),
        (Dashboard, "panel_color", (0, 0, 256)),
        (Watermark, "alpha", 0.0),
        (Watermark, "alpha", 1.1),
        (Watermark, "size", -1.0),
        (Watermark, "color", (1, 2)),
        (Watermark, "text", "  "),
    ],
)
def test_bad_fields_are_named(effect: type[Dashboard] | type[Watermark], field: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"for {effect.__name__}\n{field}(\.\d)?\n"):
        dataclasses.replace(effect(), **{field: value})
