"""How exposures start beside an artifact: from samples that it does not hide, and without a lens's falloff."""

from __future__ import annotations

import pytest
import torch

from ssa_nerfstudio.evidence.initialization import initialize_as
from ssa_nerfstudio.evidence.point_samples import PointSamples
from ssa_nerfstudio.overlay.layer import OracleOverlay, ScreenSpaceOverlay
from ssa_nerfstudio.overlay.resampling import box_reduce
from ssa_nerfstudio.plugin.artifacts import Artifacts, Overlay
from ssa_nerfstudio.plugin.camera_matching import LENS_VALUES
from ssa_nerfstudio.plugin.exposure import Exposure, Place
from ssa_nerfstudio.plugin.exposure_setup import start_beside_artifact

VIEWS, POINTS, HEIGHT, WIDTH = 12, 400, 40, 60


def layers() -> torch.Tensor:
    """T and B [H, W, 4] of an artifact in the lower quarter."""
    made = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(HEIGHT, WIDTH, 1)
    made[30:] = torch.tensor([0.4, 0.3, 0.3, 0.3])
    return made


def falloff() -> torch.Tensor:
    """F [H, W, 1]: 1 in the middle, a quarter in the corners."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    return (1 - 0.375 * (x**2 + y**2))[..., None]


def in_all_photos(overlay: Overlay) -> Artifacts:
    artifacts = Artifacts()
    artifacts.assign([overlay], torch.zeros(1, 6), [0] * VIEWS, torch.zeros(1, LENS_VALUES))
    return artifacts


def photographed(lens: torch.Tensor, place: Place) -> tuple[list[PointSamples], torch.Tensor]:
    """Samples of gray points behind artifact and lens, and the logarithms of the photos' gains [V, 3].

    Every other photo shows points in the darker half of the frame alone.
    """
    generator = torch.Generator().manual_seed(0)
    clean = (torch.rand(POINTS, 1, generator=generator) * 0.3 + 0.3).expand(POINTS, 3)
    log_gains = 0.2 * torch.randn(VIEWS, 1, generator=generator)
    log_gains = (log_gains - log_gains.mean()).expand(VIEWS, 3)
    dark = torch.argsort(falloff().flatten())[: HEIGHT * WIDTH // 2]
    samples = []
    for view, gain in enumerate(log_gains.exp()):
        pixel = torch.randint(HEIGHT * WIDTH, (POINTS,), generator=generator)
        pixel = dark[pixel % len(dark)] if view % 2 else pixel
        transmittance, addition = layers().reshape(-1, 4)[pixel].split((1, 3), dim=-1)
        behind = transmittance * gain * clean + addition * (gain if place == "photo" else 1)
        color = behind * lens.reshape(-1, 1)[pixel] + 0.003 * torch.randn(POINTS, 3, generator=generator)
        views = torch.full((POINTS,), view)
        samples.append(PointSamples(torch.arange(POINTS), pixel, color, POINTS, (HEIGHT, WIDTH), views))
    return samples, log_gains


@pytest.mark.parametrize("place", ["photo", "scene"])
@pytest.mark.parametrize(("resolution", "vignetted"), [(1, True), (2, True), (1, False)])
def test_a_falloff_is_no_artifact_that_hides_the_points(place: Place, resolution: int, vignetted: bool):
    lens = falloff() if vignetted else torch.ones(HEIGHT, WIDTH, 1)
    overlay = ScreenSpaceOverlay(HEIGHT, WIDTH, resolution)
    initialize_as(overlay, layers())
    if vignetted:
        overlay.falloff = box_reduce(lens, resolution)
    samples, log_gains = photographed(lens, place)
    exposure = Exposure(VIEWS)
    start_beside_artifact(exposure, in_all_photos(overlay), samples, choose_place=True)
    torch.testing.assert_close(exposure.transforms[:, 0].detach(), log_gains, atol=0.02, rtol=0)
    assert exposure.place == place


@pytest.mark.parametrize("place", ["photo", "scene"])
def test_given_layers_have_no_falloff(place: Place):
    transmittance, addition = layers().split((1, 3), dim=-1)
    samples, log_gains = photographed(torch.ones(HEIGHT, WIDTH, 1), place)
    exposure = Exposure(VIEWS)
    given = OracleOverlay(transmittance.expand(-1, -1, 3), addition)
    start_beside_artifact(exposure, in_all_photos(given), samples, choose_place=True)
    torch.testing.assert_close(exposure.transforms[:, 0].detach(), log_gains, atol=0.02, rtol=0)
    assert exposure.place == place
