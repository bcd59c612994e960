"""The scene takes over a film that an overlay has over all of the frame; what a photo shows stays the same."""

from __future__ import annotations

import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics
from torch import Tensor
from torch.testing import assert_close

from ssa_nerfstudio.overlay.compositing import composite
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.training.scene_brightness import clear_the_clearest, show_through

HEIGHT, WIDTH = 20, 30
FILM = torch.tensor(0.9), torch.tensor([0.05, 0.02, 0.03])


def overlay_behind_film(adds_light: bool = False, falloff: bool = False) -> ScreenSpaceOverlay:
    """A panel over a third of the frame, and nothing elsewhere, seen through FILM."""
    overlay = ScreenSpaceOverlay(HEIGHT, WIDTH, adds_light=adds_light)
    through, own = torch.ones(HEIGHT, WIDTH, 1), torch.zeros(HEIGHT, WIDTH, 3)
    through[:, 20:], own[:, 20:] = (0.7, 0.2) if adds_light else (0.4, 0.3)
    if falloff:
        overlay.falloff = torch.linspace(1.0, 0.4, WIDTH).expand(HEIGHT, WIDTH)[..., None].clone()
    own = own + through * FILM[1]
    through = through * FILM[0]
    matte = 1 - through
    with torch.no_grad():
        overlay.alpha_logits.copy_(matte.logit())
        overlay.color_logits.copy_((own if adds_light else own / matte).logit())
    return overlay


def harmonics(count: int = 50) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(count, 3, generator=generator), 0.1 * torch.randn(count, 15, 3, generator=generator)


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("falloff", [False, True])
def test_a_film_leaves_the_overlay_and_what_photos_show_stays(adds_light: bool, falloff: bool) -> None:
    overlay = overlay_behind_film(adds_light, falloff)
    clean = 0.8 * torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    before = composite(clean, *overlay.layers())
    overlay.clear(*FILM)
    assert_close(composite(FILM[0] * clean + FILM[1], *overlay.layers()), before, rtol=0, atol=2e-4)
    own = slice(0, 20) if not falloff else slice(0, 3)
    through, addition = overlay.layers()
    assert through[:, own].min() > (0.999 if not falloff else 0.95)
    assert addition[:, own].max() < 1e-3


def test_a_falloff_is_what_the_film_was_less() -> None:
    """F was found too dark by a tenth, and the scene is brighter by as much: both are mended."""
    overlay = ScreenSpaceOverlay(HEIGHT, WIDTH)
    true = torch.linspace(1.0, 0.4, WIDTH).expand(HEIGHT, WIDTH)[..., None]
    overlay.falloff = 0.9 * true
    with torch.no_grad():
        overlay.alpha_logits.fill_(-12)
    overlay.clear(torch.tensor(0.9), torch.zeros(3))
    assert_close(overlay.falloff, true)
    assert_close(overlay.layers()[0], true, rtol=0, atol=1e-4)


@pytest.mark.parametrize("share", [0.2, 0.5, 1.0])
def test_the_clearest_pixels_are_those_that_hide_least(share: float) -> None:
    overlay = overlay_behind_film()
    through, addition = overlay.clearest(share)
    if share < 1:  # the panel is a third of the frame
        assert_close((through, addition), FILM, rtol=0, atol=1e-4)
    else:
        assert through < FILM[0]


def colors(constant: Tensor, rest: Tensor, directions: Tensor) -> Tensor:
    """Of Gaussians in these directions from a camera, before they are clamped at black."""
    return _spherical_harmonics(3, directions, torch.cat([constant[:, None], rest], dim=1)) + 0.5


def test_gaussians_have_the_colors_that_the_film_gave_them_in_every_direction() -> None:
    gaussians = harmonics()
    directions = torch.randn(50, 3, generator=torch.Generator().manual_seed(2))
    before = colors(*gaussians, directions)
    show_through(*FILM, *gaussians)
    assert_close(colors(*gaussians, directions), FILM[0] * before + FILM[1], rtol=0, atol=2e-5)


def test_gaussians_without_harmonics_have_them_too() -> None:
    logits = harmonics()[0]
    before = torch.sigmoid(logits)
    show_through(*FILM, logits, torch.zeros(50, 0, 3))
    assert_close(torch.sigmoid(logits), FILM[0] * before + FILM[1])


def test_the_clearest_of_several_overlays_says_what_is_film() -> None:
    """A camera that sees more of the scene shows that what another one has over its frame is its own."""
    hazy, clear = overlay_behind_film(), ScreenSpaceOverlay(HEIGHT, WIDTH)
    with torch.no_grad():
        clear.alpha_logits.fill_(-12)
    before, gaussians = hazy.layers()[0].detach(), harmonics()
    clear_the_clearest([hazy, clear], *gaussians)
    assert_close(hazy.layers()[0].detach(), before, rtol=0, atol=1e-4)
    assert_close(gaussians, harmonics(), rtol=0, atol=1e-3)


def test_what_hides_the_scene_everywhere_is_no_film() -> None:
    overlay, gaussians = ScreenSpaceOverlay(HEIGHT, WIDTH), harmonics()
    with torch.no_grad():
        overlay.alpha_logits.fill_(1.0)
    clear_the_clearest([overlay], *gaussians)
    assert_close(gaussians, harmonics(), rtol=0, atol=0)
    assert (overlay.alpha_logits == 1).all()


@pytest.mark.parametrize("model", [{}, {"overlay_film": "kept"}, {"exposure": "affine"}], ids=str)
def test_a_training_ends_with_a_clear_frame_unless_something_else_decides_its_brightness(
    model, tiny_scene, tmp_path, configure_training, train_and_evaluate
) -> None:
    """An overlay that starts as a film of 0.1 everywhere has learned little in five steps."""
    settings = {"overlay": "on", "overlay_start": "constant", "num_downscales": 0, "strategy": "adc", **model}
    _, pipeline, _ = train_and_evaluate(configure_training("ssa-splatfacto", tiny_scene, tmp_path, 5, settings))
    (overlay,) = pipeline.model.artifacts.learned()
    assert (float(overlay.clearest(0.2)[0]) > 0.99) == (not model)
