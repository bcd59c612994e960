"""A render brought to a photo's exposure."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.metrics.color_correction import color_corrected
from ssa_nerfstudio.metrics.image import psnr

IMAGE, OTHER = (torch.rand(12, 10, 3, generator=torch.Generator().manual_seed(s), dtype=torch.float64) for s in (0, 1))


def test_an_exposure_is_undone():
    gain, offset = torch.tensor([0.6, 0.8, 0.5]), torch.tensor([0.1, 0.0, 0.2])
    torch.testing.assert_close(color_corrected(IMAGE, gain * IMAGE + offset), gain * IMAGE + offset)


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 1), st.floats(0, 1))
def test_it_is_the_least_squares_fit(noise, blend):
    target = (blend * IMAGE + (1 - blend) * OTHER + noise * (OTHER - 0.5)).clamp(0, 1)
    corrected = color_corrected(IMAGE, target)
    for channel in range(3):
        x, y = IMAGE[..., channel].flatten().numpy(), target[..., channel].flatten().numpy()
        fit = np.polyval(np.polyfit(x, y, 1), x).clip(0, 1)
        np.testing.assert_allclose(corrected[..., channel].flatten(), fit, atol=1e-9)
    assert psnr(corrected, target) >= min(psnr(IMAGE, target), 200.0) - 1e-9, (
        "beyond that both differ by rounding alone"
    )


def test_channels_are_not_mixed_and_structure_still_counts():
    assert psnr(color_corrected(IMAGE, IMAGE[..., [1, 2, 0]]), IMAGE[..., [1, 2, 0]]) < 15


def test_a_constant_channel_gets_the_photos_mean():
    render = IMAGE.clone()
    render[..., 0] = 0.3
    corrected = color_corrected(render, OTHER)
    torch.testing.assert_close(corrected[..., 0], OTHER[..., 0].mean().expand(12, 10))
