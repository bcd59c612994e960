"""The sparsity loss against its formula and finite differences; and the optimizer's eps that it needs."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.sparsity import Sparsity, sparsity_loss

opacity = st.floats(0, 1)
flat = torch.ones(3, 4, 1, dtype=torch.float64)


@settings(max_examples=30, deadline=None)
@given(values=st.lists(opacity, min_size=12, max_size=12), evidence=opacity)
def test_l1_sparsity_is_the_mean_of_the_matte_whatever_the_evidence(values: list[float], evidence: float) -> None:
    matte = torch.tensor(values, dtype=torch.float64).reshape(3, 4, 1)
    assert sparsity_loss(matte, evidence * flat, "l1").item() == pytest.approx(math.fsum(values) / 12, abs=1e-14)


def test_log_sparsity_is_0_without_a_matte_and_1_for_an_opaque_one_that_the_views_disagree_on() -> None:
    assert sparsity_loss(0 * flat, flat, "log") == 0
    assert sparsity_loss(flat, flat, "log").item() == pytest.approx(1, abs=1e-15)


@settings(max_examples=50, deadline=None)
@given(alpha=opacity, evidence=opacity)
def test_log_sparsity_is_the_formula_of_its_description(alpha: float, evidence: float) -> None:
    expected = (0.1 + 0.9 * evidence) * math.log(1 + alpha / 0.1) / math.log(1 + 1 / 0.1)
    assert sparsity_loss(alpha * flat, evidence * flat, "log").item() == pytest.approx(expected, abs=1e-14)


def test_log_sparsity_weighs_each_pixel_by_its_own_evidence() -> None:
    matte = torch.tensor([0.2, 0.9], dtype=torch.float64).reshape(1, 2, 1)
    evidence = torch.tensor([1.0, 0.0], dtype=torch.float64).reshape(1, 2, 1)
    weighed = sparsity_loss(matte, evidence, "log")
    apart = sparsity_loss(matte[:, :1], evidence[:, :1], "log") + sparsity_loss(matte[:, 1:], evidence[:, 1:], "log")
    torch.testing.assert_close(weighed, apart / 2)


@settings(max_examples=50, deadline=None)
@given(alphas=st.tuples(opacity, opacity), share=opacity, evidence=opacity)
def test_log_sparsity_grows_with_the_matte_ever_more_slowly(
    alphas: tuple[float, float], share: float, evidence: float
) -> None:
    def penalty(alpha: float) -> float:
        return sparsity_loss(alpha * flat, evidence * flat, "log").item()

    low, high = sorted(alphas)
    between = share * low + (1 - share) * high
    assert penalty(low) <= penalty(between) + 1e-14 <= penalty(high) + 2e-14
    assert penalty(between) >= share * penalty(low) + (1 - share) * penalty(high) - 1e-14


def test_log_sparsity_is_strictly_concave_and_l1_is_not() -> None:
    middle = sparsity_loss(0.5 * flat, flat, "log").item()
    assert middle > 0.5 * sparsity_loss(flat, flat, "log").item() + 0.2
    assert sparsity_loss(0.5 * flat, flat, "l1").item() == 0.5


def test_log_sparsity_spares_pixels_whose_views_agree() -> None:
    matte = 0.7 * flat
    agreed, disputed = sparsity_loss(matte, 0 * flat, "log"), sparsity_loss(matte, flat, "log")
    assert agreed.item() == pytest.approx(0.1 * disputed.item())
    assert agreed > 0, "an unneeded matte still has to vanish"


def test_log_sparsity_has_a_large_gradient_on_a_faint_matte_and_a_small_one_on_an_opaque_one() -> None:
    slopes = []
    for alpha in (0.0, 0.1, 1.0):
        matte = (alpha * flat).requires_grad_()
        sparsity_loss(matte, flat, "log").backward()
        assert matte.grad is not None
        slopes.append(12 * matte.grad[0, 0, 0].item())
    assert slopes[0] == pytest.approx(10 / math.log(11))
    assert slopes[1] == pytest.approx(slopes[0] / 2)
    assert slopes[2] == pytest.approx(slopes[0] / 11)


def test_no_sparsity_is_zero() -> None:
    loss = sparsity_loss(flat, flat, "off")
    assert loss == 0
    assert loss.shape == ()
    assert loss.dtype == flat.dtype


@pytest.mark.parametrize("kind", ["l1", "log"])
def test_the_gradient_of_sparsity_is_that_of_finite_differences(kind: Sparsity) -> None:
    generator = torch.Generator().manual_seed(0)
    matte, evidence = torch.rand(2, 4, 5, 1, dtype=torch.float64, generator=generator)
    matte.requires_grad_()
    assert torch.autograd.gradcheck(lambda matte: sparsity_loss(matte, evidence, kind), (matte,))


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
