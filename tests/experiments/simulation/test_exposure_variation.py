"""Simulated exposure: its mean, what it acts on, and the datasets that have it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_datasets import contents, pixels, write_dataset

from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.simulation.exposure_variation import draw_exposures
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects
from ssa_nerfstudio.experiments.simulation.simulator import simulate


@pytest.mark.parametrize("photos", [1, 2, 50])
def test_the_mean_exposure_is_the_identity(photos):
    gain, offset = draw_exposures(0.3, photos, 0)
    np.testing.assert_allclose(np.log(gain).mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=1e-12)


def test_spread_and_seed_decide():
    gain, offset = draw_exposures(0.3, 2000, 0)
    assert abs(np.log(gain).std() - 0.31) < 0.02  # of the photos 0.3, of the channels around them a quarter of it
    assert abs(offset.std() - 0.03) < 0.003
    assert not np.allclose(gain, draw_exposures(0.3, 2000, 1)[0])
    np.testing.assert_array_equal(gain, draw_exposures(0.3, 2000, 0)[0])
    assert (draw_exposures(0.0, 5, 0)[0] == 1).all()


@pytest.fixture
def data(tmp_path) -> Path:
    return write_dataset(tmp_path / "data", suffix=".png")


@pytest.mark.parametrize("effect", ["mud", "watermark", None])
def test_photos_are_those_of_the_stated_exposures_and_layers(effect, data, tmp_path):
    """In front of the lens E(T C + B), drawn by software T E(C) + B; test photos stay as they are."""
    out = tmp_path / "out"
    main(
        [
            "simulate",
            "--data",
            str(data),
            "--output",
            str(out),
            "--exposure",
            "0.3",
            "--effects",
            *filter(None, [effect]),
        ]
    )
    described = json.loads((out / "exposure.json").read_text())
    assert [each["photo"] for each in described] == json.loads((out / "transforms.json").read_text())["train_filenames"]
    layers = {"T": 1.0, "B": 0.0}
    if effect:
        with np.load(out / "layers" / "raw.npz") as stored:
            layers = {name: stored[name].astype(np.float64) for name in ("T", "B")}
    assert (out / "layers").exists() == (effect is not None)
    for each in described:
        clean = pixels(data / each["photo"]) / 255
        gain, offset = np.array(each["gain"]), np.array(each["offset"])
        if effect == "watermark":
            formed = layers["T"] * (gain * clean + offset).clip(0, 1) + layers["B"]
        else:
            formed = gain * (layers["T"] * clean + layers["B"]).clip(0, 1) + offset
        wrong = pixels(out / each["photo"]) - 255 * formed.clip(0, 1)
        assert abs(wrong).max() < 0.5 * (1 + gain.max()) + 0.01  # rounded twice
    for name in json.loads((out / "transforms.json").read_text())["test_filenames"]:
        assert (out / name).read_bytes() == (data / name).read_bytes()


def test_the_record_repeats_the_run(data, tmp_path):
    main(
        [
            "simulate",
            "--data",
            str(data),
            "--output",
            str(tmp_path / "a"),
            "--effects",
            "ui",
            "--exposure",
            "0.2",
            "--seed",
            "3",
        ]
    )
    main(
        [
            "simulate",
            "--data",
            str(data),
            "--output",
            str(tmp_path / "b"),
            "--scene",
            str(tmp_path / "a" / "scene.yaml"),
        ]
    )
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_without_variation_nothing_is_different(data, tmp_path):
    for name, more in (("a", []), ("b", ["--exposure", "0"])):
        main(["simulate", "--data", str(data), "--output", str(tmp_path / name), "--effects", "ui", *more])
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert not (tmp_path / "a" / "exposure.json").exists()


def test_effects_of_both_kinds_are_refused(data, tmp_path):
    scene = Scene(read_effects(("mud", "watermark")), exposure=0.2)
    with pytest.raises(InputError, match="both kinds"):
        simulate(Dataset.read(data, 8), scene, tmp_path / "out", 1)
    assert not (tmp_path / "out").exists()


def test_the_spread_is_bounded(data, tmp_path):
    with pytest.raises(SystemExit) as ended:
        main(["simulate", "--data", str(data), "--output", str(tmp_path / "out"), "--effects", "ui", "--exposure", "2"])
    assert ended.value.code == 2
