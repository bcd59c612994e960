"""The photometric loss: kernels against plain torch, pytorch_msssim and finite differences."""

from __future__ import annotations

import logging

import pytest
import torch
from conftest import check_in_tritons_interpreter
from hypothesis import given, settings
from hypothesis import strategies as st
from pytorch_msssim import ssim as msssim_ssim
from torch import Tensor

from ssa_nerfstudio.overlay import photometric
from ssa_nerfstudio.overlay.photometric import gaussian_window, photometric_loss, photometric_reference, ssim

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
    value, gradient = value_and_gradient(photometric_loss, prediction, target, weight)
    assert value > 0.01
    wide = prediction.double(), target.double()
    for oracle in (photometric_reference, by_msssim):
        expected, slope = value_and_gradient(oracle, *wide, weight)
        assert value.item() == pytest.approx(expected.item(), abs=TOLERANCE[dtype])
        assert (gradient - slope).norm() < TOLERANCE[dtype] * slope.norm()


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
    value, gradient = value_and_gradient(photometric_loss, prediction, target, weight)
    expected, slope = value_and_gradient(photometric_reference, prediction, target, weight)
    assert value.item() == pytest.approx(expected.item(), rel=1e-12, abs=1e-14)
    assert (gradient - slope).norm() < 1e-12 * slope.norm()


@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_the_gradient_of_the_photometric_loss_is_that_of_finite_differences(weight: float) -> None:
    prediction, target = pair(12, 13)
    assert ((prediction - target).abs() > 1e-4).all(), "the kink of L1 is too near"
    prediction.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: 100 * photometric_loss(x, target, weight), (prediction,), atol=1e-6)


def test_the_gradient_is_scaled_by_the_incoming_one() -> None:
    prediction, target = pair(15, 16)
    _, once = value_and_gradient(photometric_loss, prediction, target, 0.2)
    _, thrice = value_and_gradient(lambda *a: 3 * photometric_loss(*a) + 1, prediction, target, 0.2)
    torch.testing.assert_close(thrice, 3 * once)


def test_only_the_prediction_receives_a_gradient() -> None:
    prediction, target = (image.requires_grad_() for image in pair(15, 16))
    photometric_loss(prediction, target, 0.2).backward()
    assert prediction.grad is not None
    assert target.grad is None


@pytest.mark.parametrize(("height", "width"), [(10, 40), (40, 10), (1, 1)])
def test_images_too_small_for_the_window_are_compared_by_l1_alone(height: int, width: int) -> None:
    prediction, target = pair(height, width)
    value, gradient = value_and_gradient(photometric_loss, prediction, target, 0.2)
    torch.testing.assert_close(value, (prediction - target).abs().mean())
    torch.testing.assert_close(gradient, (prediction - target).sign() / prediction.numel())


def test_at_weight_zero_it_is_l1_and_at_weight_one_it_is_one_minus_ssim() -> None:
    prediction, target = pair(20, 25)
    torch.testing.assert_close(photometric_loss(prediction, target, 0), (prediction - target).abs().mean())
    torch.testing.assert_close(photometric_loss(prediction, target, 1), 1 - ssim(prediction, target))


@both_dtypes
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_identical_images_have_no_loss(weight: float, dtype: torch.dtype) -> None:
    _, target = pair(20, 25, dtype)
    value, gradient = value_and_gradient(photometric_loss, target, target, weight)
    assert abs(value.item()) < 10 * torch.finfo(dtype).eps
    assert gradient.norm() < 1e3 * torch.finfo(dtype).eps


@both_dtypes
def test_photometric_value_and_gradient_are_the_same_bits_on_any_number_of_threads(dtype: torch.dtype) -> None:
    prediction, target = pair(600, 40, dtype, seed=2)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        value, gradient = value_and_gradient(photometric_loss, prediction, target, 0.2)
        for threads in (2, 3, 5, 2, 3, 5):
            torch.set_num_threads(threads)
            again = value_and_gradient(photometric_loss, prediction, target, 0.2)
            assert torch.equal(again[0], value), f"the value differs on {threads} threads"
            assert torch.equal(again[1], gradient), f"the gradient differs on {threads} threads"
    finally:
        torch.set_num_threads(before)


def test_the_layout_of_the_images_in_memory_does_not_matter() -> None:
    prediction, target = pair(20, 25)
    expected = value_and_gradient(photometric_loss, prediction, target, 0.2)
    planar = [image.permute(2, 0, 1).contiguous().permute(1, 2, 0) for image in (prediction, target)]
    leaf = planar[0].requires_grad_()
    value = photometric_loss(leaf, planar[1], 0.2)
    value.backward()
    assert not leaf.is_contiguous()
    assert torch.equal(value.detach(), expected[0])
    assert torch.equal(leaf.grad, expected[1])  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("broken", ["prediction", "target"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_the_loss_is_not_finite_where_a_pixel_is_not(value: float, broken: str) -> None:
    prediction, target = pair(20, 25, torch.float32)
    (prediction if broken == "prediction" else target)[7, 9, 1] = value
    assert not photometric_loss(prediction, target, 0.2).isfinite()


INTERPRETED = """
import torch
from ssa_nerfstudio.overlay._kernels.photometric_triton import value_and_gradient
from ssa_nerfstudio.overlay import photometric
from ssa_nerfstudio.overlay.photometric import gaussian_window, photometric_reference

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


def test_a_missing_triton_is_reported_once(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    photometric._triton_available.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert not photometric._triton_available()
        assert not photometric._triton_available()
    photometric._triton_available.cache_clear()
    assert caplog.text.count("Triton is not installed") == 1


def test_tritons_kernels_are_the_formula_in_its_interpreter() -> None:
    check_in_tritons_interpreter(INTERPRETED)


def test_triton_is_looked_for_by_its_name(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object() if name == "triton" else None)
    photometric._triton_available.cache_clear()
    assert photometric._triton_available()
    photometric._triton_available.cache_clear()
    assert not caplog.text


def test_devices_without_kernels_compute_in_plain_torch_and_stay_on_the_device() -> None:
    """The device `meta` stands for any that is neither a CPU nor CUDA."""
    prediction = torch.zeros(20, 25, 3, device="meta", requires_grad=True)
    value = photometric_loss(prediction, torch.zeros(20, 25, 3, device="meta"), 0.2)
    assert (value.device.type, value.shape) == ("meta", ())
    value.backward()
    assert prediction.grad is not None
    assert prediction.grad.shape == (20, 25, 3)
