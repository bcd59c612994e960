"""Gains of photos, and whether the artifact has them, from samples of known scenes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from ssa_nerfstudio.evidence.photo_exposure import artifact_follows, relative_gains
from ssa_nerfstudio.evidence.point_samples import PointSamples

VIEWS, POINTS, SIZE = 12, 300, (10, 20)


def scene(spread: float, place: str = "photo", matte: float = 0.0, outliers: float = 0.0):
    """Samples of gray points under gains, the right half of the frame behind an artifact; its layers; the gains."""
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(POINTS, 1, generator=generator) * 0.4 + 0.2
    log_gains = spread * torch.randn(VIEWS, 1, generator=generator)
    log_gains = (log_gains - log_gains.mean()).expand(VIEWS, 3)
    layers = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(*SIZE, 1)
    layers[:, 10:] = torch.tensor([1 - matte, *[0.5 * matte] * 3])
    views = []
    for gain in log_gains.exp():
        pixel = torch.randint(SIZE[0] * SIZE[1], (POINTS,), generator=generator)
        transmittance, addition = layers.reshape(-1, 4)[pixel].split((1, 3), dim=-1)
        clean = colors.expand(POINTS, 3)
        shown = gain * (transmittance * clean + addition)
        shown = shown if place == "photo" else transmittance * gain * clean + addition
        shown = shown + 0.01 * torch.randn(POINTS, 3, generator=generator)
        wrong = torch.rand(POINTS, 1, generator=generator) < outliers
        shown = torch.where(wrong, torch.rand(POINTS, 3, generator=generator), shown).clamp(0, 1)
        views.append(PointSamples(torch.arange(POINTS), pixel, shown, POINTS, SIZE, torch.zeros(POINTS).long()))
    return views, [layers] * VIEWS, log_gains


def test_photos_without_any_noise_have_one_exposure():
    samples, _, _ = scene(0.0)
    assert (relative_gains([replace(each, color=torch.full_like(each.color, 0.5)) for each in samples]) == 0).all()


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_gains_are_found_among_outliers(outliers):
    samples, _, log_gains = scene(0.3, outliers=outliers)
    found = relative_gains(samples)
    assert (found - log_gains).abs().max() < 0.02 + 0.1 * outliers
    torch.testing.assert_close(found.mean(dim=0), torch.zeros(3), atol=1e-6, rtol=0)


def test_one_exposure_is_found_as_such():
    samples, _, _ = scene(0.0)
    assert relative_gains(samples).abs().max() < 0.01


def test_a_photo_without_samples_has_the_mean_exposure():
    samples, _, _ = scene(0.0)
    none = torch.zeros(0).long()
    nothing = PointSamples(none, none, torch.zeros(0, 3), POINTS, SIZE, none)
    found = relative_gains([nothing, *samples])
    assert found.isfinite().all()
    assert found[0].abs().max() < 0.01
    assert (relative_gains([nothing, nothing]) == 0).all()


def test_what_an_artifact_hides_half_of_has_the_gain_of_the_other_half():
    samples, layers, log_gains = scene(0.3, "scene", matte=1.0)
    assert (relative_gains(samples, layers) - log_gains).abs().max() < 0.03
    assert (relative_gains(samples) - log_gains).abs().max() > 0.1


@pytest.mark.parametrize("place", ["scene", "photo"])
@pytest.mark.parametrize("matte", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("spread", [0.1, 0.3])
def test_what_the_artifact_follows_is_told_from_what_it_does_not(place, matte, spread):
    samples, layers, log_gains = scene(spread, place, matte, outliers=0.1)
    assert artifact_follows(samples, layers, log_gains) == (place == "photo")
    assert artifact_follows(samples, layers, relative_gains(samples, layers)) == (place == "photo")


def test_a_clear_frame_says_nothing():
    samples, _, log_gains = scene(0.3)
    assert artifact_follows(samples, [None] * VIEWS, log_gains) is None
