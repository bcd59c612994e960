"""Datasets behind artifacts that no effect draws."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.unusual_artifacts import SHAPES, Command, Drawn
from ssa_nerfstudio.errors import InputError


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_covers_a_part_of_frames_of_any_size_and_is_drawn_alike(shape):
    for height, width in ((61, 97), (97, 61)):
        layers, again = (Drawn(shape).layers(height, width, np.random.default_rng(0)) for _ in range(2))
        assert layers.transmittance.shape == (height, width, 3)
        assert np.array_equal(layers.transmittance, again.transmittance)
        assert np.array_equal(layers.addition, again.addition)
        seen = np.abs(layers.transmittance - 1).max(axis=2) + layers.addition.max(axis=2) > 0.05
        assert 0.005 < seen.mean() < 0.95


def test_a_dataset_for_each_shape_that_is_not_there_yet(tiny_scene, tmp_path, capsys):
    Command(tiny_scene, tmp_path / "out", ("letterbox", "flare")).run()
    folder = tmp_path / "out" / f"{tiny_scene.name}-letterbox"
    assert capsys.readouterr().out.split() == [str(folder), str(folder.with_name(f"{tiny_scene.name}-flare"))]
    with np.load(folder / "layers" / "raw.npz") as layers:
        middle = len(layers["T"]) // 2
        assert layers["T"][0].max() == layers["B"].max() == 0
        assert layers["T"][middle].min() == 1
    before = (folder / "transforms.json").stat().st_mtime_ns
    Command(tiny_scene, tmp_path / "out", ("letterbox",)).run()
    assert (folder / "transforms.json").stat().st_mtime_ns == before


def test_an_unknown_shape_is_named_before_anything_is_written(tiny_scene, tmp_path):
    with pytest.raises(InputError, match="no shape 'square'"):
        Command(tiny_scene, tmp_path / "out", ("letterbox", "square")).run()
    assert not (tmp_path / "out").exists()
