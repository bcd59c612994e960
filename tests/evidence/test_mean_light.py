"""A second estimate in the artifact's mean light."""

from __future__ import annotations

from dataclasses import replace

import torch

from ssa_nerfstudio.evidence.artifact_light import artifact_light
from ssa_nerfstudio.evidence.detection import detect
from ssa_nerfstudio.evidence.initialization import estimate, guide_of, initialize_from
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate
from ssa_nerfstudio.evidence.mean_light import light_of_samples, refine_in_mean_light
from ssa_nerfstudio.evidence.point_samples import View, sample_points
from ssa_nerfstudio.evidence.statistics import accumulate
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.shading import basis_of, shading_basis

HEIGHT, WIDTH, VIEWS = 90, 120, 24
K = torch.tensor([[100.0, 0.0, WIDTH / 2], [0.0, 100.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
TRANSMITTANCE, COLOR = 0.25, torch.tensor([0.5, 0.35, 0.3])


def texture(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Of a wall at depth 1: [..., 3] in [0.1, 0.9]."""
    waves = [0.25 * (torch.sin(9 * x + 5 * i) + torch.sin(11 * y + 3 * x + 2 * i)) for i in range(3)]
    return (0.5 + 0.8 * torch.stack(waves, dim=-1)).clamp(0.1, 0.9)


def finger() -> tuple[torch.Tensor, torch.Tensor]:
    """Layers of what covers the left third of the frame."""
    opacity = (1 - TRANSMITTANCE) * (torch.arange(WIDTH) < WIDTH // 3).float().expand(HEIGHT, WIDTH)[..., None]
    return 1 - opacity, opacity * COLOR


def views(gains: torch.Tensor, sway: int = 0) -> list[View]:
    """A camera that moves along the wall, behind a finger with these logarithms of gains, which moves by pixels."""
    generator, found = torch.Generator().manual_seed(3), []
    transmittance, addition = finger()
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    for gain in gains:
        pose = torch.eye(4)
        pose[:2, 3] = 0.8 * torch.rand(2, generator=generator) - 0.4
        wall = texture((columns - WIDTH / 2) / 100 - pose[0, 3], (rows - HEIGHT / 2) / 100 - pose[1, 3])
        shift = int(torch.randint(-sway, sway + 1, (), generator=generator))
        own, lit = transmittance.roll(shift, dims=1), addition.roll(shift, dims=1)
        photo = (own * wall + gain.exp() * lit).clamp(0, 1)
        found.append(View((255 * photo).round().to(torch.uint8), None, pose, K))
    return found


def points() -> torch.Tensor:
    x, y = 2 * torch.rand(2, 6000, generator=torch.Generator().manual_seed(4)) - 1
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def changing() -> torch.Tensor:
    gains = 0.15 * torch.randn(VIEWS, generator=torch.Generator().manual_seed(1))
    return gains - gains.mean()


def expected() -> torch.Tensor:
    """The gains [V] of the linear light in the middle of a finger of this opacity, whose mean is the mean light."""
    factor = changing().exp()
    return (factor / factor.mean() - 1) / (1 - TRANSMITTANCE)


class Start:
    """The start from photos as they are, and what a second estimate is made of."""

    def __init__(self, photos: list[View]) -> None:
        statistics = accumulate((view.image, view.mask) for view in photos)
        self.detection, self.guide, self.photos = detect(statistics), guide_of(statistics), photos
        self.samples = sample_points(points(), photos, self.guide)
        self.found = estimate(self.samples, self.guide, self.detection.opaque, self.detection.mask)
        self.overlay = ScreenSpaceOverlay(HEIGHT, WIDTH)
        initialize_from(self.overlay, self.found, self.guide, self.detection.mask)
        self.error = error(self.overlay)

    def refined(self, found: LayerEstimate | None = None) -> LayerEstimate:
        found = found or self.found
        return refine_in_mean_light(self.overlay, found, self.samples, self.guide, self.photos, self.detection)


def error(overlay: ScreenSpaceOverlay) -> float:
    """Mean absolute error of T where the finger is, without its edge."""
    return float((overlay.layers()[0].detach() - TRANSMITTANCE)[:, : WIDTH // 3 - 8].abs().mean())


def test_where_the_light_changes_a_second_estimate_is_nearer_to_the_truth():
    start = Start(views(changing()))
    second = start.refined()
    assert second.noise < start.found.noise
    assert error(start.overlay) < min(0.015, 0.7 * start.error)
    assert start.overlay.noise == second.noise


def test_in_constant_light_the_first_estimate_holds():
    start = Start(views(torch.zeros(VIEWS)))
    before = {name: value.clone() for name, value in start.overlay.state_dict().items()}
    assert start.refined() is start.found
    assert all(torch.equal(value, before[name]) for name, value in start.overlay.state_dict().items())


def test_a_second_estimate_that_leaves_more_noise_is_dropped():
    start = Start(views(changing()))
    less = replace(start.found, noise=torch.tensor(1e-6))
    assert start.refined(less) is less
    assert error(start.overlay) == start.error


def test_light_is_told_from_the_scene_that_comes_through():
    """A fit of the photos alone takes what is smooth in the scene for light: here an error of 0.2."""
    start = Start(views(changing()))
    basis = basis_of(start.overlay)
    samples = light_of_samples(start.samples, start.found, basis, VIEWS)
    images = [view.image for view in start.photos]
    photos = artifact_light(images, [None] * VIEWS, basis, start.overlay.layers()).coefficients

    def wrong(coefficients: torch.Tensor) -> float:
        return float((coefficients[:, :3] - expected()[:, None]).square().mean().sqrt())

    assert wrong(samples) < 0.06
    assert wrong(samples) < 0.5 * wrong(photos)
    torch.testing.assert_close(samples.mean(dim=0), torch.zeros(5), atol=1e-6, rtol=0)


def test_a_view_without_samples_has_the_mean_light():
    start = Start(views(changing()))
    keep = start.samples.view != 7
    few = {name: getattr(start.samples, name)[keep] for name in ("point", "pixel", "color", "view")}
    found = light_of_samples(replace(start.samples, **few, patch=None), start.found, basis_of(start.overlay), VIEWS)
    others = torch.cat([found[:7], found[8:]])
    torch.testing.assert_close(found[7], -others.sum(dim=0), atol=1e-5, rtol=0)
    assert found[7].abs().max() < 0.1 * found.abs().max()
    nowhere = torch.zeros_like(basis_of(start.overlay))
    assert (light_of_samples(start.samples, start.found, nowhere, VIEWS) == 0).all()


def test_behind_a_falloff_light_is_found_all_the_same():
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, HEIGHT), torch.linspace(-1, 1, WIDTH), indexing="ij")
    falloff = (1 - 0.2 * (rows.square() + columns.square()))[..., None]
    darkened = [replace(v, image=(v.image * falloff).round().to(torch.uint8)) for v in views(changing())]
    start = Start(darkened)
    known = replace(start.found, falloff=falloff, addition=finger()[1], transmittance=finger()[0])
    known = replace(known, colors=Start(views(torch.zeros(VIEWS))).found.colors)
    found = light_of_samples(start.samples, known, shading_basis(1 - finger()[0]), VIEWS)
    torch.testing.assert_close(found[:, :3].mean(dim=1), expected(), atol=0.06, rtol=0)
