"""Overlays as pictures: over a checkerboard, and as RGBA."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssa_nerfstudio.overlay.rgba import over_checkerboard, to_rgba8


@pytest.mark.parametrize("side", [1, 3, 8])
def test_a_clear_overlay_shows_gray_squares_that_alternate(side):
    shown = over_checkerboard(torch.rand(20, 30, 3), torch.zeros(20, 30, 1), side).numpy()
    rows, columns = np.mgrid[:20, :30]
    light = (rows // side + columns // side) % 2 == 0
    np.testing.assert_allclose(shown, np.where(light, 0.5, 0.35)[..., None].repeat(3, axis=2), rtol=1e-6)


def test_an_opaque_overlay_hides_the_squares_and_half_of_one_mixes():
    color = torch.rand(9, 9, 3)
    torch.testing.assert_close(over_checkerboard(color, torch.ones(9, 9, 1)), color)
    clear = over_checkerboard(color, torch.zeros(9, 9, 1))
    torch.testing.assert_close(over_checkerboard(color, torch.full((9, 9, 1), 0.25)), 0.25 * color + 0.75 * clear)


@pytest.mark.parametrize("channels", [1, 3])
def test_rgba_is_straight_and_rounded(channels):
    """A pixel of color (0.2, 0.4, 0.6) and matte 0.5; one that is clear; one that is opaque."""
    transmittance = torch.tensor([[0.5], [1.0], [0.0]]).expand(3, channels)[None]
    addition = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0], [1.0, 0.0, 0.502]])[None]
    expected = [[51, 102, 153, 128], [0, 0, 0, 0], [255, 0, 128, 255]]
    rgba = to_rgba8(transmittance, addition)
    assert rgba.dtype == np.uint8
    np.testing.assert_array_equal(rgba[0], expected)


def test_the_board_has_squares_of_eight_pixels_and_the_precision_of_the_colors():
    clear = torch.zeros(20, 30, 1, dtype=torch.float64)
    color = torch.rand(20, 30, 3, dtype=torch.float64)
    assert torch.equal(over_checkerboard(color, clear), over_checkerboard(color, clear, 8))
    assert set(over_checkerboard(color, clear).unique().tolist()) == {0.35, 0.5}


def test_the_board_is_made_where_the_colors_are():
    """The device `meta` stands for any that is not the CPU."""
    color, alpha = torch.zeros(20, 30, 3, device="meta"), torch.zeros(20, 30, 1, device="meta")
    assert over_checkerboard(color, alpha).device.type == "meta"


def test_light_beyond_white_is_white_in_eight_bits():
    rgba = to_rgba8(torch.ones(1, 1, 1), torch.tensor([[[1.7, 0.5, 0.0]]]))
    assert rgba[0, 0].tolist() == [255, 128, 0, 255]
