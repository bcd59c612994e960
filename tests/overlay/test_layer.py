"""The overlay: its layers at every scale, compositing, held pixels, and its state dict."""

from __future__ import annotations

import io
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nerfstudio.models.splatfacto import resize_image
from torch import Tensor

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.overlay.compositing import clip_straight_through, composite
from ssa_nerfstudio.overlay.layer import OracleOverlay, ScreenSpaceOverlay


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def randomized(height: int, width: int, resolution: int = 1, adds_light: bool = False) -> ScreenSpaceOverlay:
    """An overlay with random parameters and evidence."""
    overlay = ScreenSpaceOverlay(height, width, resolution, adds_light)
    generator = torch.Generator().manual_seed(height * width)
    with torch.no_grad():
        for parameter in overlay.parameters():
            parameter.copy_(2 * torch.randn(parameter.shape, generator=generator))
        overlay.evidence.copy_(torch.rand(overlay.evidence.shape, generator=generator))
    return overlay


def test_a_new_overlay_has_the_constant_start_of_the_paper() -> None:
    overlay = ScreenSpaceOverlay(5, 7)
    torch.testing.assert_close(overlay.color(), torch.full((5, 7, 3), 0.5))
    torch.testing.assert_close(overlay.matte(), torch.full((5, 7, 1), 0.1))
    assert (overlay.evidence == 1).all()


@pytest.mark.parametrize("reduction", [1, 2, 4])
@pytest.mark.parametrize(("height", "width"), [(16, 24), (17, 23), (18, 21), (5, 4)])
def test_layers_are_reduced_as_nerfstudio_reduces_the_photos(height: int, width: int, reduction: int) -> None:
    overlay = randomized(height, width)
    transmittance, addition = overlay.layers(reduction)
    color, matte = overlay.color(), overlay.matte()
    full = torch.cat([1 - matte, matte * color], dim=-1)
    expected = full if reduction == 1 else resize_image(full, reduction)
    torch.testing.assert_close(torch.cat([transmittance, addition], dim=-1), expected)


def test_compositing_at_half_size_is_reducing_the_composite_where_the_render_is_smooth() -> None:
    overlay = randomized(12, 16)
    coarse = random(6, 8, 3)
    fine = coarse.repeat_interleave(2, 0).repeat_interleave(2, 1)
    torch.testing.assert_close(
        composite(coarse, *overlay.layers(2)), resize_image(composite(fine, *overlay.layers()), 2)
    )


@pytest.mark.parametrize("reduction", [1, 2, 4])
@pytest.mark.parametrize("resolution", [1, 2, 4])
@pytest.mark.parametrize(("height", "width"), [(16, 24), (17, 23), (13, 30)])
def test_an_overlay_of_any_resolution_is_drawn_at_the_size_of_the_photos(
    height: int, width: int, resolution: int, reduction: int
) -> None:
    overlay = ScreenSpaceOverlay(height, width, resolution)
    assert overlay.matte().shape == (-(-height // resolution), -(-width // resolution), 1)
    assert overlay.evidence.shape == overlay.matte().shape
    transmittance, addition = overlay.layers(reduction)
    assert transmittance.shape == (height // reduction, width // reduction, 1)
    assert addition.shape == (height // reduction, width // reduction, 3)
    torch.testing.assert_close(transmittance, torch.full_like(transmittance, 0.9))
    torch.testing.assert_close(addition, torch.full_like(addition, 0.05))


@settings(max_examples=40, deadline=None)
@given(clean=st.floats(0, 1), color=st.floats(0.01, 0.99), alpha=st.floats(0.01, 0.99))
def test_compositing_is_the_equation_of_the_paper(clean: float, color: float, alpha: float) -> None:
    overlay = ScreenSpaceOverlay(1, 1).double()
    with torch.no_grad():
        overlay.color_logits.fill_(math.log(color / (1 - color)))
        overlay.alpha_logits.fill_(math.log(alpha / (1 - alpha)))
    drawn = composite(torch.full((1, 1, 3), clean, dtype=torch.float64), *overlay.layers())
    torch.testing.assert_close(drawn, torch.full_like(drawn, alpha * color + (1 - alpha) * clean))


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("resolution", [1, 2])
@pytest.mark.parametrize("reduction", [1, 2])
def test_gradients_of_compositing_are_those_of_finite_differences(
    reduction: int, resolution: int, adds_light: bool
) -> None:
    overlay = randomized(5, 6, resolution, adds_light).double()
    clean = random(5 // reduction, 6 // reduction, 3, dtype=torch.float64).requires_grad_()

    def drawn(clean: Tensor, *_: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return composite(clean, *overlay.layers(reduction)), overlay.opacity(), overlay.color()

    assert torch.autograd.gradcheck(drawn, (clean, *overlay.parameters()))


def test_additive_light_needs_no_matte_and_sparsity_weighs_the_light() -> None:
    overlay = ScreenSpaceOverlay(2, 3, adds_light=True).double()
    with torch.no_grad():
        overlay.alpha_logits.fill_(-12.0)
        overlay.color_logits.copy_(torch.tensor([0.3, 0.2, 0.1]).logit().expand(2, 3, 3))
    clean = random(2, 3, 3, dtype=torch.float64)
    added = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64).expand(2, 3, 3)
    torch.testing.assert_close(composite(clean, *overlay.layers()), clean + added, rtol=0, atol=1e-5)
    torch.testing.assert_close(overlay.opacity(), added[..., :1])


def test_clipping_passes_the_gradient_of_a_prediction_beyond_white() -> None:
    image = torch.tensor([-0.5, 0.2, 1.5], requires_grad=True)
    clipped = clip_straight_through(image)
    assert clipped.tolist() == pytest.approx([0.0, 0.2, 1.0])
    (clipped - 0.9).abs().sum().backward()
    assert image.grad is not None
    assert image.grad.tolist() == [-1.0, -1.0, 1.0]


def test_the_gradient_of_the_scene_is_scaled_by_the_transmittance() -> None:
    overlay = randomized(4, 5)
    clean = random(4, 5, 3).requires_grad_()
    composite(clean, *overlay.layers()).sum().backward()
    torch.testing.assert_close(clean.grad, (1 - overlay.matte()).expand(4, 5, 3))


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("resolution", [1, 2])
def test_a_state_dict_restores_the_overlay(resolution: int, adds_light: bool) -> None:
    overlay = randomized(9, 13, resolution, adds_light)
    file = io.BytesIO()
    torch.save(overlay.state_dict(), file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    again = ScreenSpaceOverlay(*state["frame"].tolist())
    again.load_state_dict(state)
    assert (again.height, again.width, again.resolution, again.adds_light) == (9, 13, resolution, adds_light)
    assert torch.equal(again.evidence, overlay.evidence)
    for reduction in (1, 2, 4):
        for found, expected in zip(again.layers(reduction), overlay.layers(reduction), strict=True):
            assert torch.equal(found, expected)


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("reduction", [1, 2])
@pytest.mark.parametrize("resolution", [1, 2])
def test_a_falloff_darkens_scene_and_artifact_alike_and_is_no_concern_of_sparsity(
    resolution: int, reduction: int, adds_light: bool
) -> None:
    overlay = randomized(12, 16, resolution, adds_light)
    clean = random(12 // reduction, 16 // reduction, 3)
    behind = random(12 // reduction, 16 // reduction, 1), random(3)
    before, opacity = overlay.composite(clean, reduction, behind), overlay.opacity()
    overlay.falloff = torch.full_like(overlay.evidence, 0.6)
    torch.testing.assert_close(overlay.composite(clean, reduction, behind), 0.6 * before)
    torch.testing.assert_close(composite(clean, *overlay.layers(reduction)), 0.6 * before)
    assert torch.equal(overlay.opacity(), opacity)


@pytest.mark.parametrize("adds_light", [False, True])
@pytest.mark.parametrize("reduction", [1, 2])
def test_the_scene_learns_nothing_where_the_artifact_changes_and_the_overlay_does(
    reduction: int, adds_light: bool
) -> None:
    overlay = randomized(12, 16, 1, adds_light)
    clean = random(12 // reduction, 16 // reduction, 3).requires_grad_()
    with_all = overlay.composite(clean, reduction)
    overlay.reliable = torch.ones(12, 16, 1)
    overlay.reliable[:, 8:] = 0
    image = overlay.composite(clean, reduction)
    assert torch.equal(image, with_all)
    (before,) = torch.autograd.grad(with_all.sum(), clean)
    image.sum().backward()
    assert clean.grad is not None
    assert overlay.alpha_logits.grad is not None
    torch.testing.assert_close(clean.grad[:, : 8 // reduction], before[:, : 8 // reduction])
    assert (clean.grad[:, 8 // reduction :] == 0).all()
    assert (overlay.alpha_logits.grad[:, 8:] != 0).all()


def test_a_state_dict_of_another_frame_is_refused() -> None:
    with pytest.raises(RuntimeError, match="size mismatch"):
        ScreenSpaceOverlay(9, 13).load_state_dict(ScreenSpaceOverlay(13, 9).state_dict())


def test_an_oracle_overlay_keeps_its_layers_and_is_reduced_like_the_photos() -> None:
    transmittance, addition = random(11, 14, 3, seed=1), 0.7 * random(11, 14, 3, seed=2)
    overlay = OracleOverlay(transmittance, addition)
    assert (overlay.height, overlay.width) == (11, 14)
    found = overlay.layers()
    assert torch.equal(found[0], transmittance)
    assert torch.equal(found[1], addition)
    for reduction in (2, 4):
        found = overlay.layers(reduction)
        torch.testing.assert_close(found[0], resize_image(transmittance, reduction))
        torch.testing.assert_close(found[1], resize_image(addition, reduction))
    assert not list(overlay.parameters()), "an oracle overlay is not learned"


def test_a_state_dict_restores_an_oracle_overlay() -> None:
    overlay = OracleOverlay(random(6, 8, 3), random(6, 8, 3, seed=1))
    again = OracleOverlay(torch.ones(6, 8, 3), torch.zeros(6, 8, 3))
    again.load_state_dict(overlay.state_dict())
    assert torch.equal(again.layers()[0], overlay.layers()[0])
    assert torch.equal(again.layers()[1], overlay.layers()[1])


clear, dark = torch.ones(4, 5, 3), torch.zeros(4, 5, 3)


@pytest.mark.parametrize(
    ("transmittance", "addition", "message"),
    [
        (clear[..., :1], dark, "must both be"),
        (clear[..., :1], dark[..., :1], "must both be"),
        (clear[0], dark[0], "must both be"),
        (clear, dark[:3], r"they are \(4, 5, 3\) and \(3, 5, 3\)"),
        (
            clear.clone().index_fill_(0, torch.tensor(1), float("nan")),
            dark,
            "^T or B holds values that are not finite$",
        ),
        (clear, dark.clone().index_fill_(0, torch.tensor(1), float("inf")), "not finite"),
        (1.001 * clear, dark, "T must lie in"),
        (clear - 1.001, dark, "T must lie in"),
    ],
)
def test_impossible_layers_of_an_oracle_overlay_are_refused(
    transmittance: Tensor, addition: Tensor, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        OracleOverlay(transmittance, addition)


def test_layers_of_an_overlay_that_adds_light_keep_their_color_whatever_the_matte() -> None:
    overlay = randomized(6, 8, adds_light=True)
    transmittance, addition = overlay.layers()
    torch.testing.assert_close(transmittance, 1 - overlay.matte())
    torch.testing.assert_close(addition, overlay.color())


def test_the_sparsity_of_added_light_counts_the_larger_of_hiding_and_lighting_at_every_pixel() -> None:
    overlay = randomized(6, 8, adds_light=True)
    brightest = overlay.color().amax(dim=-1, keepdim=True)
    torch.testing.assert_close(overlay.opacity(), torch.maximum(overlay.matte(), brightest))
    assert overlay.opacity().shape == (6, 8, 1)


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 1), (3, 5, 4), (1, 3, 5, 3)])
def test_layers_of_an_oracle_are_named_with_their_shapes(shape) -> None:
    with pytest.raises(InputError) as refused:
        OracleOverlay(torch.ones(shape), torch.zeros(3, 5, 3))
    assert f"they are {shape} and (3, 5, 3)" in str(refused.value)


@pytest.mark.parametrize("value", [-1e-3, 1.001])
def test_one_transmittance_out_of_range_is_enough(value) -> None:
    transmittance = torch.full((3, 5, 3), 0.5)
    transmittance[2, 4, 1] = value
    with pytest.raises(InputError, match=r"T must lie in \[0, 1\]"):
        OracleOverlay(transmittance, torch.zeros(3, 5, 3))


def test_an_oracle_says_its_frame() -> None:
    overlay = OracleOverlay(torch.ones(3, 5, 3, dtype=torch.float64), torch.zeros(3, 5, 3, dtype=torch.float64))
    assert overlay.frame.tolist() == [3, 5, 1, 0]
    assert {layer.dtype for layer in overlay.layers()} == {torch.float32}
    clean = random(3, 5, 3)
    torch.testing.assert_close(overlay.composite(clean), clean)


def test_an_overlay_starts_from_what_is_given_and_never_so_far_out_that_it_cannot_move() -> None:
    overlay = ScreenSpaceOverlay(2, 2).double()
    color = torch.tensor([[[0.2, 0.4, 0.6], [0.0, 1.0, 0.5]], [[0.3, 0.3, 0.3], [1.0, 0.0, 0.0]]], dtype=torch.float64)
    alpha = torch.tensor([[[0.7], [0.0]], [[1.0], [0.02]]], dtype=torch.float64)
    evidence = torch.tensor([[[0.1], [0.9]], [[1.0], [0.0]]], dtype=torch.float64)
    overlay.initialize(color, alpha, evidence)
    torch.testing.assert_close(overlay.color(), color.clamp(1 / 510, 509 / 510))
    assert overlay.matte().flatten().tolist() == pytest.approx([0.7, 0.01, 0.99, 0.02])
    assert torch.equal(overlay.evidence, evidence)
    assert all(parameter.requires_grad and parameter.is_leaf for parameter in overlay.parameters())


def test_logits_that_ran_away_come_back_to_where_a_gradient_moves_them() -> None:
    overlay = ScreenSpaceOverlay(1, 3).double()
    with torch.no_grad():
        overlay.alpha_logits.copy_(torch.tensor([-50.0, 1.0, 50.0]).reshape(1, 3, 1))
        overlay.color_logits.copy_(torch.tensor([-50.0, 2.0, 50.0]).expand(1, 3, 3))
    overlay.clamp_logits()
    assert overlay.alpha_logits.flatten().tolist() == pytest.approx([-12.0, 1.0, math.log(999)])
    assert overlay.color_logits[0, 0].tolist() == [-12.0, 2.0, 12.0]
    assert overlay.matte().max().item() == pytest.approx(0.999)


@pytest.mark.parametrize("adds_light", [False, True])
def test_a_camera_of_many_pixels_says_its_size(adds_light: bool) -> None:
    overlay = ScreenSpaceOverlay(5, 7, 2, adds_light)
    assert overlay.frame.tolist() == [5, 7, 2, int(adds_light)]
    assert overlay.frame.dtype == torch.int64
    learned, known = {"color_logits", "alpha_logits"}, {"frame", "evidence", "falloff", "reliable", "noise"}
    assert set(overlay.state_dict()) == learned | known
