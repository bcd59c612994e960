"""Compositing over splats: the matte has no gradient towards hiding background where no artifact was found."""

from __future__ import annotations

import pytest
import torch

from ssa_nerfstudio.overlay.compositing import composite, composite_logits, composite_over_splats
from ssa_nerfstudio.overlay.layer import MATTE_LOGIT_RANGE, ScreenSpaceOverlay
from ssa_nerfstudio.overlay.sparsity import sparsity_loss


def scene(accumulation: float) -> tuple[ScreenSpaceOverlay, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A gray-blue overlay over splats of the same color and the given opacity, in front of a red background."""
    overlay = ScreenSpaceOverlay(4, 5).double()
    color = torch.tensor([0.3, 0.4, 0.5], dtype=torch.float64)
    with torch.no_grad():
        overlay.color_logits.copy_(color.logit().expand_as(overlay.color_logits))
    background = torch.tensor([0.9, 0.1, 0.1], dtype=torch.float64)
    opacity = torch.full((4, 5, 1), accumulation, dtype=torch.float64)
    clean = opacity * color + (1 - opacity) * background
    return overlay, clean, opacity, background


def any_overlay(resolution: int, adds_light: bool, generator: torch.Generator) -> ScreenSpaceOverlay:
    """An overlay of 6 x 8 pixels with random logits."""
    overlay = ScreenSpaceOverlay(6, 8, resolution, adds_light).double()
    with torch.no_grad():
        for parameter in overlay.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return overlay


def matte_gradient(accumulation: float, over_splats: bool) -> torch.Tensor:
    """How the error to a photo of the overlay's color changes with the matte."""
    overlay, clean, opacity, background = scene(accumulation)
    transmittance, addition = overlay.layers()
    if over_splats:
        image = composite_over_splats(clean, opacity, background, transmittance, addition)
    else:
        image = composite(clean, transmittance, addition)
    (image - overlay.color().detach()).square().sum().backward()
    assert overlay.alpha_logits.grad is not None
    return overlay.alpha_logits.grad


def test_the_image_is_that_of_plain_compositing():
    overlay, clean, opacity, background = scene(0.3)
    layers = overlay.layers()
    torch.testing.assert_close(
        composite_over_splats(clean, opacity, background, *layers), composite(clean, *layers), rtol=0, atol=1e-15
    )


def test_plain_compositing_rewards_hiding_background_and_compositing_over_splats_does_not():
    assert (matte_gradient(0.0, over_splats=False) < 0).all()
    assert matte_gradient(0.0, over_splats=True).abs().max() < 1e-12


def test_the_matte_has_no_gradient_where_splats_explain_the_photo():
    assert matte_gradient(0.6, over_splats=True).abs().max() < 1e-12


@pytest.mark.parametrize("accumulation", [0.0, 0.4, 1.0])
def test_a_matte_beside_additive_light_hides_no_background(accumulation):
    """Its gradient is that over a black background, whatever the background is; the light's own is the plain one."""
    overlay = ScreenSpaceOverlay(4, 5, adds_light=True).double()
    color = torch.tensor([0.3, 0.4, 0.5], dtype=torch.float64)
    opacity, found = torch.full((4, 5, 1), accumulation, dtype=torch.float64), []
    for background, over_splats in (([0.9, 0.1, 0.1], True), ([0.0, 0.0, 0.0], False)):
        behind = opacity, torch.tensor(background, dtype=torch.float64)
        clean = opacity * color + (1 - opacity) * behind[1]
        overlay.zero_grad()
        image = overlay.composite(clean, behind=behind if over_splats else None)
        image.backward(torch.full_like(image, 0.7))
        found.append((overlay.alpha_logits.grad, overlay.color_logits.grad))
    for ours, plain in zip(*found, strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-12, atol=1e-15)
    assert (found[0][0] == 0).all() == (accumulation == 0)


def test_where_splats_are_opaque_the_gradient_is_the_plain_one():
    torch.testing.assert_close(matte_gradient(1.0, True), matte_gradient(1.0, False), rtol=1e-12, atol=1e-15)


def test_splats_and_color_get_the_plain_gradient():
    overlay, clean, opacity, background = scene(0.4)
    gradients = []
    for function in (
        lambda c, t, b: composite(c, t, b),
        lambda c, t, b: composite_over_splats(c, opacity, background, t, b),
    ):
        leaf = clean.clone().requires_grad_()
        overlay.zero_grad()
        (function(leaf, *overlay.layers()) ** 2).sum().backward()
        gradients.append((leaf.grad, overlay.color_logits.grad))
    for ours, plain in zip(gradients[1], gradients[0], strict=True):
        torch.testing.assert_close(ours, plain)


@pytest.mark.parametrize("over_splats", [True, False])
def test_composite_logits_has_the_values_and_gradients_of_the_layers(over_splats):
    generator = torch.Generator().manual_seed(0)
    overlay = any_overlay(1, False, generator)
    opacity, clean, target = (torch.rand(6, 8, c, generator=generator, dtype=torch.float64) for c in (1, 3, 3))
    behind = (opacity, torch.tensor([0.9, 0.1, 0.1], dtype=torch.float64)) if over_splats else None
    found = []
    for by_hand in (True, False):
        leaf = clean.clone().requires_grad_()
        overlay.zero_grad()
        if by_hand:
            image = composite_logits(leaf, overlay.color_logits, overlay.alpha_logits, behind)
        elif behind is None:
            image = composite(leaf, *overlay.layers())
        else:
            image = composite_over_splats(leaf, *behind, *overlay.layers())
        (image - target).square().sum().backward()
        found.append((image.detach(), leaf.grad, overlay.color_logits.grad, overlay.alpha_logits.grad))
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("resolution", [1, 2])
@pytest.mark.parametrize("reduction", [1, 2])
@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("over_splats", [True, False])
def test_an_overlay_composites_its_layers(resolution, reduction, adds_light, over_splats):
    generator = torch.Generator().manual_seed(1)
    overlay = any_overlay(resolution, adds_light, generator)
    clean = torch.rand(6 // reduction, 8 // reduction, 3, generator=generator, dtype=torch.float64)
    behind = (clean[..., :1], torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)) if over_splats else None
    found = []
    for ours in (True, False):
        overlay.zero_grad()
        if ours:
            shown = overlay.composite(clean, reduction, behind)
        elif behind is None:
            shown = composite(clean, *overlay.layers(reduction))
        else:
            shown = composite_over_splats(clean, *behind, *overlay.layers(reduction), adds_light)
        (shown**2).sum().backward()
        found.append((shown.detach(), overlay.color_logits.grad, overlay.alpha_logits.grad))
    for mine, expected in zip(*found, strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("resolution", [1, 2])
@pytest.mark.parametrize("reduction", [1, 2])
@pytest.mark.parametrize("in_light", [False, True])
def test_the_gradient_is_plain_where_the_scene_is_known_to_be_hidden(adds_light, resolution, reduction, in_light):
    """Elsewhere it is the one over splats; scene and color get the plain one everywhere, because no matte is opaque."""
    generator = torch.Generator().manual_seed(2)
    overlay = any_overlay(resolution, adds_light, generator)
    overlay.alpha_logits.data.clamp_(max=2.0)
    clean = torch.rand(6 // reduction, 8 // reduction, 3, generator=generator, dtype=torch.float64).requires_grad_()
    behind = (torch.rand(*clean.shape[:2], 1, generator=generator).double(), torch.tensor([0.2, 0.5, 0.9]).double())
    seen = torch.rand(clean.shape, generator=generator, dtype=torch.float64)
    light = 0.5 + torch.rand(clean.shape, generator=generator, dtype=torch.float64) if in_light else None
    if in_light:
        overlay.falloff = torch.full((6 // resolution, 8 // resolution, 1), 0.8, dtype=torch.float64)

    def gradients(evidence: torch.Tensor | float, over: tuple | None = behind) -> list[torch.Tensor]:
        overlay.evidence.copy_(torch.as_tensor(evidence))
        image = overlay.composite(clean, reduction, over, light)
        return list(torch.autograd.grad(image, [clean, overlay.color_logits, overlay.alpha_logits], seen))

    plain, over_splats = gradients(1.0, None), gradients(1.0)
    assert (plain[2] - over_splats[2]).abs().min() > 1e-6
    some = torch.rand(overlay.evidence.shape, generator=generator) < 0.5
    everywhere = torch.ones_like(some)
    # Resampled, a pixel's gradient is that of several pixels.
    for hidden in (everywhere, ~everywhere, *([some] if resolution == reduction == 1 else [])):
        *others, found = gradients(torch.where(hidden, 0.09, 0.11))
        torch.testing.assert_close(found, torch.where(hidden, plain[2], over_splats[2]), rtol=1e-12, atol=1e-14)
        for ours, theirs in zip(others, plain, strict=False):
            torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("resolution", [1, 2])
@pytest.mark.parametrize("reduction", [1, 2])
@pytest.mark.parametrize("in_light", [False, True])
def test_the_scene_learns_nothing_where_initialization_and_matte_say_that_it_is_hidden(
    adds_light, resolution, reduction, in_light
):
    """Each quarter of the frame has another answer; the image, the color's and the matte's gradient stay the same."""
    generator = torch.Generator().manual_seed(4)
    overlay = any_overlay(resolution, adds_light, generator)
    matte, evidence = torch.full((6, 8, 1), 1 - 1.1 / 255), torch.full((6, 8, 1), 0.11)
    matte[2:], evidence[:, 4:] = 1 - 0.9 / 255, 0.09
    each = slice(None, None, resolution)
    with torch.no_grad():
        overlay.alpha_logits.copy_(matte[each, each].logit())
    clean = torch.rand(6 // reduction, 8 // reduction, 3, generator=generator, dtype=torch.float64)
    behind = torch.ones(*clean.shape[:2], 1, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    light = 0.5 + torch.rand(clean.shape, generator=generator, dtype=torch.float64) if in_light else None
    seen = torch.rand(clean.shape, generator=generator, dtype=torch.float64)

    def result(known: torch.Tensor | float, over: tuple | None = behind) -> list[torch.Tensor]:
        overlay.evidence.copy_(torch.as_tensor(known))
        leaf = clean.clone().requires_grad_()
        image = overlay.composite(leaf, reduction, over, light)
        wanted = [leaf, overlay.color_logits, overlay.alpha_logits]
        return [image.detach(), *torch.autograd.grad(image, wanted, seen)]

    free, found = result(1.0), result(evidence[each, each])
    for index in (0, 2, 3):
        torch.testing.assert_close(found[index], free[index], rtol=1e-12, atol=1e-14)
    shown = torch.ones(6, 8, 1, dtype=torch.bool)
    shown[2:, 4:] = False
    torch.testing.assert_close(found[1], free[1] * shown[::reduction, ::reduction], rtol=1e-12, atol=1e-14)
    assert (free[1] != 0).all()
    plain = result(evidence[each, each], over=None)
    torch.testing.assert_close(plain[1], free[1], rtol=1e-12, atol=1e-14)  # plain compositing is as in the paper


def test_what_an_opaque_panel_lacks_does_not_color_splats_that_nothing_else_shows():
    """A panel's color is 0.001 off, through 0.1 % of transmittance: the scene would take the whole difference."""
    found = []
    for known in (0.01, 1.0):
        overlay = ScreenSpaceOverlay(1, 1)
        overlay.initialize(torch.full((1, 1, 3), 0.5), torch.full((1, 1, 1), 0.99), torch.full((1, 1, 1), known))
        with torch.no_grad():
            overlay.alpha_logits.fill_(MATTE_LOGIT_RANGE[1])
        splats = torch.full((1, 1, 3), 0.5, requires_grad=True)
        optimizer = torch.optim.Adam([splats], lr=0.01)
        for _ in range(100):
            shown = overlay.composite(splats, behind=(torch.ones(1, 1, 1), torch.zeros(3)))
            optimizer.zero_grad()
            (shown - 0.501).abs().sum().backward()
            optimizer.step()
        found.append(float((splats.detach() - 0.5).abs().max()))
    assert found[0] == 0
    assert found[1] > 0.5


@pytest.mark.parametrize(("evidence", "hidden"), [(0.3, True), (0.4, False)])
def test_whether_the_scene_is_hidden_is_said_by_the_mean_over_a_pixel_of_the_photo(evidence, hidden):
    """Three of the four pixels of the overlay that make one of the photo have 0.02: a mean of 0.09 or 0.115."""
    overlay = ScreenSpaceOverlay(2, 2).double()
    overlay.evidence.fill_(0.02)
    overlay.evidence[1, 0] = evidence
    behind = torch.full((1, 1, 1), 0.3).double(), torch.tensor([0.2, 0.5, 0.9]).double()
    found = []
    for over in (behind, None):
        image = overlay.composite(torch.full((1, 1, 3), 0.7).double(), 2, over)
        found.append(torch.autograd.grad(image.sum(), overlay.alpha_logits)[0])
    assert torch.allclose(*found, rtol=1e-12, atol=1e-14) == hidden


@pytest.mark.parametrize(("opacity", "found", "stays"), [(0.99, 1.0, True), (0.92, 0.92, True), (0.99, 0.0, False)])
def test_a_known_artifact_stays_opaque_where_no_photo_shows_the_scene(opacity, found, stays):
    """No splat is behind it, as in a corner that no photo shows. Nothing found: the sparsity takes the overlay away."""
    generator = torch.Generator().manual_seed(3)
    overlay, photo = ScreenSpaceOverlay(3, 3), torch.tensor([0.2, 0.3, 0.25]).expand(3, 3, 3)
    overlay.initialize(photo, torch.full((3, 3, 1), opacity), torch.full((3, 3, 1), 1 - found))
    optimizer = torch.optim.Adam([overlay.alpha_logits, overlay.color_logits], lr=0.02)
    for _ in range(600):
        background = torch.rand(3, generator=generator)
        shown = overlay.composite(background.expand(3, 3, 3), behind=(torch.zeros(3, 3, 1), background))
        loss = (shown - photo).abs().mean() + 0.02 * sparsity_loss(overlay.opacity(), overlay.evidence, "log")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        overlay.clamp_logits()
    assert (overlay.matte().min() > 0.9) if stays else (overlay.matte().max() < 0.5)
