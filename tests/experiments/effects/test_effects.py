"""Every effect at any frame size, and what makes each of them what it is."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from albumentations import Spatter
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS, effect_class
from ssa_nerfstudio.experiments.effects.composition import Composition
from ssa_nerfstudio.experiments.effects.dust import Dust
from ssa_nerfstudio.experiments.effects.finger import Finger
from ssa_nerfstudio.experiments.effects.layers import Layers, VaryingLayers
from ssa_nerfstudio.experiments.effects.mud import Mud
from ssa_nerfstudio.experiments.effects.occlusion import Occlusion
from ssa_nerfstudio.experiments.effects.rain import Rain
from ssa_nerfstudio.experiments.effects.ui import UI
from ssa_nerfstudio.experiments.effects.vignette import Vignette


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def drawn(effect: object, height: int, width: int, seed: int = 0, view: int = 0) -> Layers:
    """One view's layers of the whole frame."""
    layers = effect.layers(height, width, rng(seed))  # type: ignore[attr-defined]
    artifact = Composition([layers])
    inside = None if artifact.box is None else artifact.view([rng(view)])
    return artifact.whole(inside, height, width)


@settings(max_examples=60, deadline=None)
@given(
    effect=st.sampled_from(list(EFFECTS)),
    height=st.integers(1, 90),
    width=st.integers(1, 90),
    seed=st.integers(0, 2**32),
)
def test_any_size_aspect_and_seed(effect, height, width, seed):
    """`Layers` itself checks shapes, types and ranges."""
    first, again = (drawn(effect_class(effect)(), height, width, seed) for _ in range(2))
    assert first.matte.shape == (height, width)
    assert np.array_equal(first.transmittance, again.transmittance)
    assert np.array_equal(first.addition, again.addition)
    photo = rng().integers(0, 256, (height, width, 3), dtype=np.uint8)
    exact = (first.transmittance.astype(np.float64) * photo / 255 + first.addition).clip(0, 1) * 255
    assert np.abs(first.apply(photo) - exact).max() <= 0.5 + 1e-3
    # Nothing but rain can be brighter than both the scene and white.
    if effect != "rain":
        assert (first.transmittance + first.addition <= 1 + 1e-3).all()


@pytest.mark.parametrize("name", ["rain", "mud", "finger", "occlusion", "dust", "dashboard", "ui"])
def test_another_seed_is_another_artifact(name):
    first, second = (drawn(effect_class(name)(), 80, 120, seed) for seed in (0, 1))
    assert not (
        np.array_equal(first.transmittance, second.transmittance) and np.array_equal(first.addition, second.addition)
    )


@pytest.mark.parametrize("effect", [Vignette(), Dust()])
def test_multiplicative_effects_add_no_light(effect):
    layers = drawn(effect, 90, 120)
    assert not layers.addition.any()
    assert (layers.transmittance == layers.transmittance[..., :1]).all()
    assert layers.matte.max() > 0.3


def test_vignette_is_radial_and_darkest_in_the_corners():
    matte = drawn(Vignette(strength=0.5, start=0.3), 60, 80).matte
    assert matte == pytest.approx(matte[::-1, ::-1], abs=1e-6)
    assert not matte[25:35, 30:50].any()
    assert matte.max() == pytest.approx(0.5, abs=0.01)
    assert (np.diff(matte[30, 40:]) >= 0).all()


def test_dust_grows_with_its_parameters_and_can_be_none():
    assert not drawn(Dust(specks=0, fibres=0), 60, 80).matte.any()
    few, many, large = (drawn(d, 200, 300).matte for d in (Dust(specks=5), Dust(specks=200), Dust(radius=0.05)))
    assert few.mean() < many.mean()
    assert few.mean() < large.mean()
    assert drawn(Dust(opacity=0.2, fibres=0, specks=1), 200, 300).matte.max() <= 0.2 + 1e-6


def test_rain_only_adds_light_and_is_albumentations_own():
    layers = drawn(Rain(), 90, 120, seed=3)
    assert (layers.transmittance == 1).all()
    photo = rng().integers(0, 256, (90, 120, 3), dtype=np.uint8)
    assert np.abs(layers.apply(photo).astype(int) - by_albumentations("rain", photo, None)).max() <= 1
    brightest = layers.addition.reshape(-1, 3).max(axis=0)
    assert brightest == pytest.approx(0.9 * 0.6 * np.array([238, 238, 175]) / 255, rel=0.02)


def test_mud_is_composited_brown_and_albumentations_own():
    layers = drawn(Mud(), 90, 120, seed=3)
    assert layers.addition == pytest.approx((1 - layers.transmittance) * np.array([63, 42, 20]) / 255, abs=1e-6)
    assert layers.matte.max() == pytest.approx(0.6, abs=1e-3)
    photo = rng().integers(0, 256, (90, 120, 3), dtype=np.uint8)
    assert np.abs(layers.apply(photo).astype(int) - by_albumentations("mud", photo, (63, 42, 20))).max() <= 1


def by_albumentations(mode, photo: np.ndarray, color: tuple[int, int, int] | None) -> np.ndarray:
    """The photo as the transform itself corrupts it, seeded as the simulator seeds it for seed 3."""
    transform = Spatter(mode=mode, color=color, p=1.0)
    transform.set_random_seed(int(rng(3).integers(2**31)))
    return transform(image=photo)["image"].astype(int)


def test_albumentations_default_mud_is_blue():
    """Why brown is the default here."""
    red, _, blue = Spatter(mode="mud").color
    assert blue > red


def test_ui_keeps_to_the_edges():
    matte = drawn(UI(), 480, 640).matte
    assert not matte[160:350, 130:480].any()
    for corner in (
        matte[:120, :200],
        matte[:120, -200:],
        matte[-120:, -200:],
        matte[-120:, 200:440],
        matte[-120:, :200],
    ):
        assert corner.max() == pytest.approx(1, abs=1e-6)
    assert 0.05 < (matte > 0).mean() < 0.3
    assert (drawn(UI(scale=0.5), 480, 640).matte > 0).mean() < 0.5 * (matte > 0).mean()


@pytest.mark.parametrize(
    ("side", "edge"), [("left", np.s_[:, 0]), ("right", np.s_[:, -1]), ("top", np.s_[0]), ("bottom", np.s_[-1])]
)
def test_finger_comes_from_its_edge_and_reaches_as_far_as_told(side, edge):
    effect = Finger(side=side, position=0.5, reach=0.5, blur=0.1)
    matte = drawn(effect, 200, 200).matte
    assert matte[edge].max() > 0.97
    lines = np.flatnonzero((matte > 0.49).any(axis=1 if side in ("top", "bottom") else 0))
    assert np.ptp(lines) == pytest.approx(100, abs=8)
    ramp = (matte > 0.02) & (matte < 0.95)
    assert ramp.mean() > 0.05


def test_finger_keeps_its_matte_and_varies_its_light():
    views = [drawn(Finger(), 90, 120, view=view) for view in range(12)]
    assert all(np.array_equal(view.transmittance, views[0].transmittance) for view in views)
    means = np.array([view.addition.sum() for view in views])
    assert 0.02 < means.std() / means.mean() < 0.2
    still = [drawn(Finger(variation=0), 90, 120, view=view) for view in range(2)]
    assert np.array_equal(still[0].addition, still[1].addition)


@pytest.mark.parametrize("corner", ["bottom-left", "bottom-right", "top-left", "top-right"])
def test_occlusion_comes_from_its_corner(corner):
    matte = drawn(Occlusion(corner=corner, drift=0), 120, 160).matte
    rows, columns = (slice(-8, None) if part in ("bottom", "right") else slice(0, 8) for part in corner.split("-"))
    assert (matte[rows, columns] > 0.9).mean() > 0.3
    opposite = np.s_[:60] if corner.startswith("bottom") else np.s_[60:]
    assert matte[opposite].mean() < matte.mean()


def test_occlusion_sways_by_a_few_pixels():
    def center(view: int, drift: float) -> np.ndarray:
        matte = drawn(Occlusion(drift=drift, reach=0.4), 200, 300, view=view).matte
        matte = matte[:-60, 60:]  # the joint, without what the frame cuts off
        y, x = np.mgrid[: matte.shape[0], : matte.shape[1]]
        return np.array([(matte * y).sum(), (matte * x).sum()]) / matte.sum()

    swaying = np.array([center(view, 2.0) for view in range(16)])
    assert 0.7 < swaying.std(axis=0).mean() < 3
    assert np.array([center(view, 0.0) for view in range(4)]).std(axis=0).max() < 1e-6


def test_what_varies_stays_in_its_box():
    for effect in (Finger(variation=0.4), Occlusion(drift=9.0)):
        layers = effect.layers(90, 120, rng())
        assert isinstance(layers, VaryingLayers)
        outline = [layers.view(rng(view)) for view in range(30)]
        rows, columns = layers.box
        edges = [(rows.start, np.s_[0]), (columns.start, np.s_[:, 0])]
        edges += [(90 - rows.stop, np.s_[-1]), (120 - columns.stop, np.s_[:, -1])]
        for room, edge in edges:
            if room > 0:
                assert max(view.matte[edge].max() for view in outline) < 0.05


@pytest.mark.parametrize(
    ("effect", "field", "value"),
    [
        (Dust, "specks", -1),
        (Dust, "radius", 0.0),
        (Dust, "opacity", 1.01),
        (Dust, "softness", float("nan")),
        (Finger, "side", "middle"),
        (Finger, "position", -0.1),
        (Finger, "reach", 0.0),
        (Finger, "blur", 0.6),
        (Finger, "variation", 0.6),
        (Finger, "color", (1, 2, 300)),
        (Mud, "intensity", 0.0),
        (Mud, "color", (1, 2)),
        (Mud, "blur", 0.0),
        (Occlusion, "corner", "left"),
        (Occlusion, "drift", -1.0),
        (Occlusion, "reflection", 1.5),
        (Rain, "intensity", 1.1),
        (Rain, "threshold", 1.1),
        (Rain, "mean", float("inf")),
        (UI, "scale", 0.1),
        (UI, "panel_alpha", 0.0),
        (UI, "text_color", (0, 0, -1)),
        (Vignette, "strength", 0.0),
        (Vignette, "start", 1.0),
    ],
)
def test_bad_fields_are_named(effect, field, value):
    with pytest.raises(ValueError, match=rf"for {effect.__name__}\n{field}(\.\d)?\n"):
        dataclasses.replace(effect(), **{field: value})


@pytest.mark.parametrize("effect", [Rain(), Mud()])
def test_without_albumentations_the_extra_is_named(effect, monkeypatch):
    monkeypatch.setitem(sys.modules, "albumentations", None)
    with pytest.raises(InputError, match=r"needs the package albumentations; pip install 'ssa-nerfstudio\[exp"):
        effect.layers(8, 8, rng())


@pytest.mark.parametrize(
    "effect",
    [name if name in ("dashboard", "rain") else pytest.param(name, marks=pytest.mark.slow) for name in EFFECTS],
)
def test_only_the_named_effect_is_loaded(effect):
    code = (
        "import sys; from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects\n"
        "import ssa_nerfstudio.cli.simulate, ssa_nerfstudio.experiments.simulation.simulator\n"
        f"Scene(read_effects(({effect!r},))).draw(30, 40)\n"
        "print(*(name for name in sys.modules))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    modules = {
        name.removeprefix("ssa_nerfstudio.experiments.effects.")
        for name in loaded
        if name.startswith("ssa_nerfstudio.experiments.eff")
    }
    assert modules & {*EFFECTS} == {effect}
    assert ("albumentations" in loaded) == (effect in ("rain", "mud"))
    assert not {"torch", "nerfstudio"} & {*loaded}


def test_vignette_falls_off_smoothly_from_its_start_to_the_corners():
    """Hermite's step 3 s^2 - 2 s^3: half of the strength half way, a sixth and five sixths near the ends."""
    matte = drawn(Vignette(strength=0.6, start=0.2), 300, 400).matte
    y, x = np.mgrid[:300, :400] + 0.5
    radius = np.hypot(x - 200, y - 150) / 250
    for s, share in ((0.25, 5 / 32), (0.5, 0.5), (0.75, 27 / 32)):
        ring = np.abs(radius - (0.2 + 0.8 * s)) < 0.005
        assert matte[ring].mean() == pytest.approx(0.6 * share, abs=0.003)


@pytest.mark.parametrize("drift", [1.0, 3.0])
def test_occlusion_sways_with_its_standard_deviation(drift):
    """By how far the mean arm has to be shifted to be each view's."""
    layers = Occlusion(drift=drift, reach=0.4, blur=0.02).layers(120, 160, rng())
    views = [layers.view(rng(view)).matte for view in range(150)]
    mean = np.mean(views, axis=0)
    # What a shift by one pixel changes, from the mean's gradient, and the shift of each view by least squares.
    down, right = np.gradient(mean)
    basis = np.stack([down.ravel(), right.ravel()], axis=1)
    shifts = np.array([np.linalg.lstsq(basis, (mean - view).ravel(), rcond=None)[0] for view in views])
    assert shifts.std(axis=0) == pytest.approx(drift, rel=0.2)
