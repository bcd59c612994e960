"""The loss terms: against their formulas, pytorch_msssim and finite differences; and the step size they need."""

from __future__ import annotations

import math

import pytest
import torch
from conftest import check_in_tritons_interpreter
from hypothesis import given, settings
from hypothesis import strategies as st
from pytorch_msssim import ssim as msssim_ssim
from torch import Tensor

from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.losses import (
    Sparsity,
    SSIMBody,
    gaussian_window,
    photometric,
    photometric_reference,
    sparsity,
    ssim,
)

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])


def pair(height: int, width: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A photo with structure at several scales, and a render of it: blurred, tinted, noisy; nowhere equal."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    waves = torch.stack([torch.sin(x / 3 + y / 7), torch.cos(x / 11 - y / 5), torch.sin(x * y / 40)], dim=-1)
    target = 0.5 + 0.3 * waves + 0.1 * torch.randn(height, width, 3, generator=generator)
    prediction = 0.1 + 0.7 * target + 0.05 * torch.randn(height, width, 3, generator=generator)
    return prediction.to(dtype).clamp(0, 1), target.to(dtype).clamp(0, 1)


def by_msssim(prediction: Tensor, target: Tensor, weight: float) -> Tensor:
    """splatfacto's loss: L1 and the SSIM of pytorch_msssim, its window in the images' precision."""
    window = torch.tensor(gaussian_window(), dtype=prediction.dtype).reshape(1, 1, 1, -1).repeat(3, 1, 1, 1)
    planes = (image.permute(2, 0, 1)[None] for image in (prediction, target))
    similarity = msssim_ssim(*planes, data_range=1.0, win=window)
    return (1 - weight) * (prediction - target).abs().mean() + weight * (1 - similarity)


def value_and_gradient(loss, prediction: Tensor, target: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    leaf = prediction.detach().clone().requires_grad_()
    value = loss(leaf, target, weight)
    value.backward()
    assert leaf.grad is not None
    return value.detach(), leaf.grad


@both_dtypes
@pytest.mark.parametrize("weight", [0.0, 0.2, 0.7, 1.0])
@pytest.mark.parametrize(("height", "width"), [(11, 11), (12, 40), (37, 11), (45, 50)])
def test_photometric_value_and_gradient_are_those_of_the_formulas(
    height: int, width: int, weight: float, dtype: torch.dtype
) -> None:
    prediction, target = pair(height, width, dtype)
    value, gradient = value_and_gradient(photometric, prediction, target, weight)
    assert value > 0.01
    wide = prediction.double(), target.double()
    for oracle in (photometric_reference, by_msssim):
        expected, slope = value_and_gradient(oracle, *wide, weight)
        assert value.item() == pytest.approx(expected.item(), abs=TOLERANCE[dtype])
        assert (gradient - slope).norm() < TOLERANCE[dtype] * slope.norm()


@pytest.mark.parametrize("body", ["convolution", "shifted-sums"])
@pytest.mark.parametrize("size", [(11, 11), (12, 30), (37, 20)])
def test_every_body_of_the_ssim_term_gives_the_same_value_and_gradient(body: SSIMBody, size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(5)
    target = torch.rand(*size, 3, generator=generator, dtype=torch.float64)
    prediction = (target + 0.2 * torch.rand(target.shape, generator=generator, dtype=torch.float64)).requires_grad_()
    values = [photometric(prediction, target, 0.2, which) for which in ("fused", body)]
    slopes = [torch.autograd.grad(value, prediction)[0] for value in values]
    torch.testing.assert_close(values[1], values[0], rtol=1e-12, atol=0)
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-9, atol=1e-15)


def test_the_window_is_that_of_pytorch_msssim() -> None:
    prediction, target = pair(40, 30, torch.float32)
    planes = (image.permute(2, 0, 1)[None] for image in (prediction, target))
    assert ssim(prediction, target).item() == pytest.approx(msssim_ssim(*planes, data_range=1.0).item(), abs=1e-6)
    assert sum(gaussian_window()) == pytest.approx(1, abs=1e-15)


@settings(max_examples=25, deadline=None)
@given(height=st.integers(11, 30), width=st.integers(11, 30), weight=st.floats(0, 1), seed=st.integers(0, 2**31 - 1))
def test_any_pair_of_images_has_the_loss_and_gradient_of_the_reference(
    height: int, width: int, weight: float, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    prediction, target = torch.rand(2, height, width, 3, dtype=torch.float64, generator=generator)
    value, gradient = value_and_gradient(photometric, prediction, target, weight)
    expected, slope = value_and_gradient(photometric_reference, prediction, target, weight)
    assert value.item() == pytest.approx(expected.item(), rel=1e-12, abs=1e-14)
    assert (gradient - slope).norm() < 1e-12 * slope.norm()


@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_the_gradient_of_the_photometric_loss_is_that_of_finite_differences(weight: float) -> None:
    prediction, target = pair(12, 13)
    assert ((prediction - target).abs() > 1e-4).all(), "the kink of L1 is too near"
    prediction.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: 100 * photometric(x, target, weight), (prediction,), atol=1e-6)


def test_the_gradient_scales_with_what_is_done_to_the_loss() -> None:
    prediction, target = pair(15, 16)
    _, once = value_and_gradient(photometric, prediction, target, 0.2)
    _, thrice = value_and_gradient(lambda *a: 3 * photometric(*a) + 1, prediction, target, 0.2)
    torch.testing.assert_close(thrice, 3 * once)


def test_only_the_prediction_receives_a_gradient() -> None:
    prediction, target = (image.requires_grad_() for image in pair(15, 16))
    photometric(prediction, target, 0.2).backward()
    assert prediction.grad is not None
    assert target.grad is None


@pytest.mark.parametrize(("height", "width"), [(10, 40), (40, 10), (1, 1)])
def test_images_too_small_for_the_window_are_compared_by_l1_alone(height: int, width: int) -> None:
    prediction, target = pair(height, width)
    value, gradient = value_and_gradient(photometric, prediction, target, 0.2)
    torch.testing.assert_close(value, (prediction - target).abs().mean())
    torch.testing.assert_close(gradient, (prediction - target).sign() / prediction.numel())


def test_at_weight_zero_it_is_l1_and_at_weight_one_it_is_one_minus_ssim() -> None:
    prediction, target = pair(20, 25)
    torch.testing.assert_close(photometric(prediction, target, 0), (prediction - target).abs().mean())
    torch.testing.assert_close(photometric(prediction, target, 1), 1 - ssim(prediction, target))


@both_dtypes
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_identical_images_lose_nothing(weight: float, dtype: torch.dtype) -> None:
    _, target = pair(20, 25, dtype)
    value, gradient = value_and_gradient(photometric, target, target, weight)
    assert abs(value.item()) < 10 * torch.finfo(dtype).eps
    assert gradient.norm() < 1e3 * torch.finfo(dtype).eps


@both_dtypes
def test_photometric_value_and_gradient_are_the_same_bits_on_any_number_of_threads(dtype: torch.dtype) -> None:
    prediction, target = pair(600, 40, dtype, seed=2)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        value, gradient = value_and_gradient(photometric, prediction, target, 0.2)
        for threads in (2, 3, 5, 2, 3, 5):
            torch.set_num_threads(threads)
            again = value_and_gradient(photometric, prediction, target, 0.2)
            assert torch.equal(again[0], value), f"the value differs on {threads} threads"
            assert torch.equal(again[1], gradient), f"the gradient differs on {threads} threads"
    finally:
        torch.set_num_threads(before)


def test_the_layout_of_the_images_in_memory_does_not_matter() -> None:
    prediction, target = pair(20, 25)
    expected = value_and_gradient(photometric, prediction, target, 0.2)
    planar = [image.permute(2, 0, 1).contiguous().permute(1, 2, 0) for image in (prediction, target)]
    leaf = planar[0].requires_grad_()
    value = photometric(leaf, planar[1], 0.2)
    value.backward()
    assert not leaf.is_contiguous()
    assert torch.equal(value.detach(), expected[0])
    assert torch.equal(leaf.grad, expected[1])  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("broken", ["prediction", "target"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_pixel_that_is_not_finite_shows_in_the_loss(value: float, broken: str) -> None:
    prediction, target = pair(20, 25, torch.float32)
    (prediction if broken == "prediction" else target)[7, 9, 1] = value
    assert not photometric(prediction, target, 0.2).isfinite()


opacity = st.floats(0, 1)
flat = torch.ones(3, 4, 1, dtype=torch.float64)


@settings(max_examples=30, deadline=None)
@given(values=st.lists(opacity, min_size=12, max_size=12), evidence=opacity)
def test_l1_sparsity_is_the_mean_of_the_matte_whatever_the_evidence(values: list[float], evidence: float) -> None:
    matte = torch.tensor(values, dtype=torch.float64).reshape(3, 4, 1)
    assert sparsity(matte, evidence * flat, "l1").item() == pytest.approx(math.fsum(values) / 12, abs=1e-14)


def test_log_sparsity_is_0_without_a_matte_and_1_for_an_opaque_one_that_the_views_disagree_on() -> None:
    assert sparsity(0 * flat, flat, "log") == 0
    assert sparsity(flat, flat, "log").item() == pytest.approx(1, abs=1e-15)


@settings(max_examples=50, deadline=None)
@given(alpha=opacity, evidence=opacity)
def test_log_sparsity_is_the_formula_of_its_description(alpha: float, evidence: float) -> None:
    expected = (0.1 + 0.9 * evidence) * math.log(1 + alpha / 0.1) / math.log(1 + 1 / 0.1)
    assert sparsity(alpha * flat, evidence * flat, "log").item() == pytest.approx(expected, abs=1e-14)


def test_log_sparsity_weighs_each_pixel_by_its_own_evidence() -> None:
    matte = torch.tensor([0.2, 0.9], dtype=torch.float64).reshape(1, 2, 1)
    evidence = torch.tensor([1.0, 0.0], dtype=torch.float64).reshape(1, 2, 1)
    weighed = sparsity(matte, evidence, "log")
    apart = sparsity(matte[:, :1], evidence[:, :1], "log") + sparsity(matte[:, 1:], evidence[:, 1:], "log")
    torch.testing.assert_close(weighed, apart / 2)


@settings(max_examples=50, deadline=None)
@given(alphas=st.tuples(opacity, opacity), share=opacity, evidence=opacity)
def test_log_sparsity_grows_with_the_matte_ever_more_slowly(
    alphas: tuple[float, float], share: float, evidence: float
) -> None:
    def penalty(alpha: float) -> float:
        return sparsity(alpha * flat, evidence * flat, "log").item()

    low, high = sorted(alphas)
    between = share * low + (1 - share) * high
    assert penalty(low) <= penalty(between) + 1e-14 <= penalty(high) + 2e-14
    assert penalty(between) >= share * penalty(low) + (1 - share) * penalty(high) - 1e-14


def test_log_sparsity_is_strictly_concave_and_l1_is_not() -> None:
    middle = sparsity(0.5 * flat, flat, "log").item()
    assert middle > 0.5 * sparsity(flat, flat, "log").item() + 0.2
    assert sparsity(0.5 * flat, flat, "l1").item() == 0.5


def test_log_sparsity_spares_what_the_views_agree_on() -> None:
    matte = 0.7 * flat
    agreed, disputed = sparsity(matte, 0 * flat, "log"), sparsity(matte, flat, "log")
    assert agreed.item() == pytest.approx(0.1 * disputed.item())
    assert agreed > 0, "but not for nothing: the matte of a pixel nobody needs has to vanish"


def test_log_sparsity_presses_on_a_faint_matte_and_lets_an_opaque_one_be() -> None:
    slopes = []
    for alpha in (0.0, 0.1, 1.0):
        matte = (alpha * flat).requires_grad_()
        sparsity(matte, flat, "log").backward()
        assert matte.grad is not None
        slopes.append(12 * matte.grad[0, 0, 0].item())
    assert slopes[0] == pytest.approx(10 / math.log(11))
    assert slopes[1] == pytest.approx(slopes[0] / 2)
    assert slopes[2] == pytest.approx(slopes[0] / 11)


def test_no_sparsity_is_zero() -> None:
    loss = sparsity(flat, flat, "off")
    assert loss == 0
    assert loss.shape == ()
    assert loss.dtype == flat.dtype


@pytest.mark.parametrize("kind", ["l1", "log"])
def test_the_gradient_of_sparsity_is_that_of_finite_differences(kind: Sparsity) -> None:
    generator = torch.Generator().manual_seed(0)
    matte, evidence = torch.rand(2, 4, 5, 1, dtype=torch.float64, generator=generator)
    matte.requires_grad_()
    assert torch.autograd.gradcheck(lambda matte: sparsity(matte, evidence, kind), (matte,))


@pytest.mark.parametrize(("eps", "lowest", "highest"), [(1e-15, 0.0, 0.2), (1e-8, 0.98, 0.99)])
def test_adam_moves_the_matte_at_real_resolutions_only_with_an_eps_below_the_gradients(
    eps: float, lowest: float, highest: float
) -> None:
    overlay = ScreenSpaceOverlay(1, 1).double()
    with torch.no_grad():
        overlay.alpha_logits.fill_(math.log(0.99 / 0.01))
    optimizer = torch.optim.Adam([overlay.alpha_logits], lr=5e-3, eps=eps)
    for _ in range(1000):
        with torch.no_grad():
            alpha = overlay.matte()
            # l_sparse mean_u A(u) over 840 x 1297 pixels, differentiated at one of them.
            overlay.alpha_logits.grad = 0.05 * alpha * (1 - alpha) / (840 * 1297)
        optimizer.step()
    assert lowest < overlay.matte().item() < highest


INTERPRETED = """
import torch
from ssa_nerfstudio.overlay._kernels.photometric_triton import value_and_gradient
from ssa_nerfstudio.overlay.losses import gaussian_window, photometric_reference

torch.manual_seed(0)
for height, width in ((11, 11), (23, 40)):
    x, y = torch.rand(2, height, width, 3)
    leaf = x.clone().requires_grad_()
    expected = photometric_reference(leaf, y, 0.2)
    expected.backward()
    value, gradient = value_and_gradient(x, y, 0.2, gaussian_window())
    torch.testing.assert_close(value, expected.detach(), rtol=1e-6, atol=0)
    torch.testing.assert_close(gradient, leaf.grad, rtol=1e-4, atol=1e-8)
print("equal")
"""


def test_tritons_kernels_are_the_formula_in_its_interpreter() -> None:
    check_in_tritons_interpreter(INTERPRETED)
