"""Hard cases of the overlay: saturation, odd frames, precision, and what holds for any overlay (properties)."""

from __future__ import annotations

import math

import pytest
import torch
from hard_cases import Case, Family
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ssa_nerfstudio.overlay.compositing import composite, composite_over_splats
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay, letterboxed_layers
from ssa_nerfstudio.overlay.photometric import SSIM_WINDOW, photometric_loss, photometric_reference
from ssa_nerfstudio.overlay.resampling import box_reduce, letterbox, premultiply, straight_color
from ssa_nerfstudio.overlay.sparsity import Sparsity, sparsity_loss

OVERLAY = Family("Overlay")


def random(*shape: int, seed: int = 0) -> Tensor:
    """The same numbers on every device, on the default one."""
    return torch.rand(*shape, generator=torch.Generator("cpu").manual_seed(seed), device="cpu").to(
        torch.get_default_device()
    )


def filled(height: int, width: int, alpha: float, color: float, resolution: int = 1) -> ScreenSpaceOverlay:
    """An overlay whose logits are all `alpha` and `color`."""
    overlay = ScreenSpaceOverlay(height, width, resolution)
    with torch.no_grad():
        overlay.alpha_logits.fill_(alpha)
        overlay.color_logits.fill_(color)
    return overlay


def step(overlay: ScreenSpaceOverlay, clean: Tensor, photo: Tensor, kind: Sparsity = "log", reduction: int = 1) -> None:
    """The whole loss of a training step and its gradients, which have to be finite."""
    transmittance, addition = overlay.layers(reduction)
    picture = composite_over_splats(clean, torch.ones(*clean.shape[:2], 1), torch.zeros(3), transmittance, addition)
    loss = photometric_loss(picture, photo, 0.2) + 0.05 * sparsity_loss(overlay.matte(), overlay.evidence, kind)
    loss.backward()
    for leaf in (*overlay.parameters(), clean):
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()
    assert math.isfinite(loss.item())


@OVERLAY.case(
    "matte logits of +40",
    "1 - sigmoid is exactly 0 in float32, and a logarithm or division of it is not finite.",
    40.0,
    0.0,
)
@OVERLAY.case("matte logits of -40", "Premultiplied color of 4e-18 is divided by its matte.", -40.0, 0.0)
@OVERLAY.case("color logits of +40", "A color of exactly 1.", 0.0, 40.0)
@OVERLAY.case("color logits of -40", "A color of exactly 0.", 0.0, -40.0)
@OVERLAY.case("all logits of +40", "An opaque white frame: nothing of the scene is left.", 40.0, 40.0)
@OVERLAY.case("all logits of -40", "No artifact at all.", -40.0, -40.0)
def _saturated(alpha: float, color: float) -> None:
    kinds: tuple[Sparsity, ...] = ("log", "l1", "off")
    for kind in kinds:
        overlay = filled(20, 24, alpha, color)
        step(overlay, random(20, 24, 3).requires_grad_(), random(20, 24, 3, seed=1), kind)
        straight, matte = straight_color(*overlay.layers())
        assert torch.isfinite(straight).all()
        assert torch.isfinite(matte).all()


@OVERLAY.case("opaque over the whole frame", "With the matte at its cap the scene behind must keep a gradient.")
def _() -> None:
    overlay, clean = filled(20, 24, 40.0, 0.0), random(20, 24, 3).requires_grad_()
    overlay.clamp_logits()
    step(overlay, clean, random(20, 24, 3, seed=1))
    assert clean.grad is not None
    assert (clean.grad.abs() > 0).float().mean() > 0.99


@OVERLAY.case("clear over the whole frame", "An empty overlay must still be able to learn an artifact.")
def _() -> None:
    overlay = filled(20, 24, -400.0, 0.0)
    overlay.clamp_logits()
    step(overlay, random(20, 24, 3).requires_grad_(), random(20, 24, 3, seed=1))
    assert overlay.alpha_logits.grad is not None
    assert (overlay.alpha_logits.grad.abs() > 1e-12).float().mean() > 0.99


@OVERLAY.case("a frame of 1 x 1", "Less than SSIM's window, and nothing to resample.", 1, 1)
@OVERLAY.case("a frame of 1 x 7", "One row: the box filter leaves none at half resolution.", 1, 7)
@OVERLAY.case("a frame of 7 x 1", "One column.", 7, 1)
@OVERLAY.case("a frame one pixel below SSIM's window", "A window that fits nowhere.", SSIM_WINDOW - 1, 30)
@OVERLAY.case("a frame of SSIM's window", "A window that fits once.", SSIM_WINDOW, SSIM_WINDOW)
@OVERLAY.case("a frame of prime sides", "No reduction divides it.", 37, 53)
def _frames(height: int, width: int) -> None:
    for resolution in (1, 2, 4):
        for reduction in (1, 2, 4):
            size = height // reduction, width // reduction
            if min(size) == 0:
                continue
            overlay = filled(height, width, 0.5, 1.0, resolution)
            transmittance, addition = overlay.layers(reduction)
            assert transmittance.shape == (*size, 1)
            assert addition.shape == (*size, 3)
            step(overlay, random(*size, 3).requires_grad_(), random(*size, 3, seed=1), reduction=reduction)


@OVERLAY.case(
    "a frame of 8k", "Sums over 33 million pixels in float32, and quantiles that stop at 16 million.", slow=True
)
def _() -> None:
    overlay = filled(4320, 7680, -2.0, 0.0)
    value = sparsity_loss(overlay.matte(), overlay.evidence, "l1")
    value.backward()
    expected = 1 / (1 + math.exp(2.0))
    assert abs(value.item() - expected) < 1e-5
    gradient = overlay.alpha_logits.grad
    assert gradient is not None
    assert abs(float(gradient.sum(dtype=torch.float64)) - expected * (1 - expected)) < 1e-5


@OVERLAY.case("1e4 long Adam steps on one gradient", "Logits drift to 500, where no gradient leads back.", 5e-2, 10_000)
@OVERLAY.case("1e5 Adam steps on one gradient", "The same at the default rate.", 5e-3, 100_000, slow=True)
def _drift(rate: float, steps: int) -> None:
    for sign in (-1.0, 1.0):
        overlay = ScreenSpaceOverlay(2, 3)
        optimizer = torch.optim.Adam(overlay.parameters(), lr=rate, eps=1e-15, fused=True)
        for _ in range(steps):
            for parameter in overlay.parameters():
                parameter.grad = torch.full_like(parameter, sign * 1e-7)
            optimizer.step()
            overlay.clamp_logits()
        optimizer.zero_grad()
        clean = random(2, 3, 3).requires_grad_()
        composite(clean, *overlay.layers()).sum().backward()
        assert clean.grad is not None
        assert clean.grad.min() >= 0.0009
        optimizer.zero_grad()
        overlay.matte().mean().backward()
        assert overlay.alpha_logits.grad is not None
        assert (overlay.alpha_logits.grad > 1e-7).all()


@OVERLAY.case(
    "gradients of 1e-14", "At 8k resolution a pixel's gradient is far below Adam's usual eps, which would freeze it."
)
def _() -> None:
    overlay = filled(1, 1, 4.0, 0.0)
    optimizer = torch.optim.Adam(overlay.parameters(), lr=5e-3, eps=1e-15, fused=True)
    for _ in range(200):
        for parameter in overlay.parameters():
            parameter.grad = torch.full_like(parameter, 1e-14)
        optimizer.step()
    assert overlay.alpha_logits.item() < 3.2


@OVERLAY.case("bfloat16 under autocast", "A matte of 0.999 rounds to 1 in half precision.", torch.bfloat16)
@OVERLAY.case("float16 under autocast", "Gradients of 1e-8 are 0 in float16.", torch.float16)
def _half(dtype: torch.dtype) -> None:
    overlay, clean = filled(20, 24, 6.9, 2.0), random(20, 24, 3).requires_grad_()
    with torch.autocast(torch.get_default_device().type, dtype=dtype):
        step(overlay, clean, random(20, 24, 3, seed=1))
    assert overlay.matte().dtype == torch.float32
    assert clean.grad is not None
    assert (clean.grad != 0).any()


@OVERLAY.case("black render and black photo", "SSIM of 0 over 0.", 0.0, 0.0)
@OVERLAY.case("white render and white photo", "No variance anywhere.", 1.0, 1.0)
@OVERLAY.case("black render and white photo", "The largest difference there is.", 0.0, 1.0)
def _flat(render: float, photo: float) -> None:
    a, b = torch.full((16, 16, 3), render, requires_grad=True), torch.full((16, 16, 3), photo)
    value = photometric_loss(a, b, 0.2)
    value.backward()
    assert a.grad is not None
    assert torch.isfinite(a.grad).all()
    torch.testing.assert_close(value, photometric_reference(a.detach(), b, 0.2), rtol=1e-5, atol=1e-6)


@OVERLAY.case("a render with one NaN", "A fast loss that hides the NaN would let the step through.", math.nan)
@OVERLAY.case("a render with one infinity", "The same of an infinity.", math.inf)
def _tells(value: float) -> None:
    render = random(16, 16, 3)
    render[7, 7, 1] = value
    render.requires_grad_()
    loss = photometric_loss(render, random(16, 16, 3, seed=1), 0.2)
    loss.backward()
    assert render.grad is not None
    assert not (torch.isfinite(loss) and torch.isfinite(render.grad).all())


@OVERLAY.case("a letterbox of one pixel", "A frame scaled to nothing must keep a pixel.")
def _() -> None:
    for size in ((1, 1), (1, 500), (500, 1)):
        for part in letterboxed_layers(filled(37, 53, 1.0, 1.0), *size):
            assert part.shape[:2] == size
            assert torch.isfinite(part).all()


# Properties of any overlay.


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(-40, 40), st.floats(-40, 40))
def _compositing(seed: int, alpha: float, color: float) -> None:
    clean = random(3, 4, 3, seed=seed)
    transmittance, addition = filled(3, 4, alpha, color).layers()
    shown = composite(clean, transmittance, addition)
    assert (shown >= -1e-6).all()
    assert (shown <= 1 + 1e-6).all()
    # Linear in the scene: the overlay of a mean is the mean of overlays.
    other = random(3, 4, 3, seed=seed + 1)
    mean = composite((clean + other) / 2, transmittance, addition)
    torch.testing.assert_close(mean, (shown + composite(other, transmittance, addition)) / 2, atol=2e-6, rtol=0)
    # Two overlays are one: T2 (T1 C + B1) + B2.
    twice = composite(shown, transmittance, addition)
    once = composite(clean, transmittance**2, transmittance * addition + addition)
    torch.testing.assert_close(twice, once, atol=2e-6, rtol=0)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 2, 4]))
def _energy(seed: int, rows: int, columns: int, factor: int) -> None:
    """Means are kept, and compositing then reducing is reducing then compositing where the scene is flat."""
    height, width = rows * factor, columns * factor
    color, alpha = random(height, width, 3, seed=seed), random(height, width, 1, seed=seed + 1)
    transmittance, addition = premultiply(color, alpha)
    small_t, small_b = box_reduce(transmittance, factor), box_reduce(addition, factor)
    torch.testing.assert_close(small_t.mean(), transmittance.mean())
    torch.testing.assert_close(small_b.mean((0, 1)), addition.mean((0, 1)))
    flat = random(1, 1, 3, seed=seed + 2)
    torch.testing.assert_close(
        box_reduce(composite(flat.expand(height, width, 3), transmittance, addition), factor),
        composite(flat.expand(rows, columns, 3), small_t, small_b),
    )


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 30), st.integers(1, 30), st.integers(1, 60), st.integers(1, 60))
def _odd_sizes(seed: int, height: int, width: int, to_height: int, to_width: int) -> None:
    """To any size and back: values stay within what they were, and a constant stays that constant."""
    layer = random(height, width, 3, seed=seed)
    there = letterbox(layer, to_height, to_width, 0.5)
    assert there.shape == (to_height, to_width, 3)
    assert there.min() >= min(layer.min(), 0.5) - 1e-6  # pyright: ignore[reportArgumentType]
    assert there.max() <= max(layer.max(), 0.5) + 1e-6  # pyright: ignore[reportArgumentType]
    constant = letterbox(torch.full((height, width, 1), 0.3), to_height, to_width, 0.3)
    back = letterbox(constant, height, width, 0.3)
    torch.testing.assert_close(back, torch.full_like(back, 0.3))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def _straight(seed: int) -> None:
    """Premultiplying and back gives color and matte again wherever there is a matte."""
    color, alpha = random(4, 5, 3, seed=seed), random(4, 5, 1, seed=seed + 1) * 0.99 + 0.01
    again, matte = straight_color(*premultiply(color, alpha))
    torch.testing.assert_close(matte, alpha, atol=1e-6, rtol=0)
    torch.testing.assert_close(again, color, atol=2e-5, rtol=0)


OVERLAY.case("any compositing", "Values leave [0, 1], or two overlays are not one.")(_compositing)
OVERLAY.case("any reduction", "Filtering straight colors leaks a clear pixel's color into its neighbors.")(_energy)
OVERLAY.case("any size and back", "Resampling rings, or drifts.")(_odd_sizes)
OVERLAY.case("any color and matte, premultiplied and back", "The division by the matte loses the color.")(_straight)


@OVERLAY.parametrize
def test_overlay(case: Case) -> None:
    case.check()


@pytest.mark.stability
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@OVERLAY.parametrize
def test_overlay_on_cuda(case: Case) -> None:
    with torch.device("cuda"):
        case.check()
