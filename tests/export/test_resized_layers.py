"""Layers at another resolution."""

from __future__ import annotations

import numpy as np
import pytest

from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers


def stripes(width: int, height: int, period: int) -> ArtifactLayers:
    """One opaque white column in every `period`."""
    transmittance = np.ones((height, width, 3), np.float32)
    transmittance[:, ::period] = 0
    lens = Lens(width, height, 50.0, 40.0, width / 2, height / 2)
    return ArtifactLayers(transmittance, 1 - transmittance, lens, "undistorted", "learned")


@pytest.mark.parametrize("factor", [2, 4, 5])
def test_no_column_is_skipped_where_layers_become_smaller(factor):
    small = stripes(20 * factor, 6 * factor, factor).sized(20, 6)
    np.testing.assert_allclose(small.transmittance, 1 - 1 / factor, atol=1e-6)
    np.testing.assert_allclose(small.addition, 1 / factor, atol=1e-6)
    assert (small.camera.fx, small.camera.fy) == (50 / factor, 40 / factor)
    assert (small.camera.cx, small.camera.cy) == (10, 3)


def test_larger_layers_are_interpolated():
    large = stripes(10, 6, 5).sized(40, 24)
    assert large.transmittance.shape == (24, 40, 3)
    expected = [1, 0.875, 0.625, 0.375, 0.125, 0.125, 0.375, 0.625, 0.875, 1]
    np.testing.assert_allclose(large.transmittance[5, 17:27, 0], expected)


def test_the_same_size_is_the_same_object():
    layers = stripes(10, 6, 5)
    assert layers.sized(10, 6) is layers
