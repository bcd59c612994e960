"""View-dependent colors against gsplat's own evaluation in torch."""

from __future__ import annotations

import pytest
import torch
from conftest import check_in_tritons_interpreter
from gsplat.cuda._torch_impl import _spherical_harmonics as evaluate
from recordings import CUDA
from torch import Tensor

from ssa_nerfstudio.rasterization import harmonics


def scene(count: int, others: int, device: str) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(count)
    return {
        "means": torch.randn(count, 3, generator=generator).to(device).requires_grad_(),
        "center": torch.randn(3, generator=generator).to(device).requires_grad_(),
        "constant": torch.randn(count, 3, generator=generator).to(device).requires_grad_(),
        "rest": torch.randn(count, others, 3, generator=generator).to(device).requires_grad_(),
        "radii": (torch.rand(count, generator=generator) > 0.2).int().to(device),
    }


def expected(given: dict[str, Tensor], degree: int) -> Tensor:
    coefficients = torch.cat([given["constant"][:, None], given["rest"]], dim=1)
    return (evaluate(degree, given["means"] - given["center"], coefficients) + 0.5).clamp_min(0.0)


def gradients(colors: Tensor, given: dict[str, Tensor]) -> list[Tensor]:
    """Of a sum over what is drawn; the color of the rest says nothing."""
    weights = torch.rand(colors.shape, generator=torch.Generator().manual_seed(1)).to(colors.device)
    total = (colors * weights)[given["radii"] > 0].sum()
    leaves = [each for each in given.values() if each.requires_grad]
    return list(torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True))


@pytest.mark.parametrize("triton", [False, pytest.param(True, marks=CUDA.marks)])
@pytest.mark.parametrize(("degree", "others"), [(0, 0), (0, 15), (1, 15), (2, 8), (3, 15), (4, 24)])
@pytest.mark.parametrize("count", [1, 1000])
def test_colors_and_their_gradients_are_gsplats(monkeypatch, triton, degree, others, count):
    device = "cuda" if torch.cuda.is_available() else "cpu"
    monkeypatch.setattr(harmonics, "_TRITON", triton)
    if device == "cpu":
        monkeypatch.setattr(harmonics, "spherical_harmonics", lambda *given, masks: evaluate(*given))
    given = scene(count, others, device)
    found = harmonics.shade(**given, degree=degree)
    visible, correct = given["radii"] > 0, expected(given, degree)
    torch.testing.assert_close(found[visible], correct[visible], rtol=1e-4, atol=1e-5)
    for one, other in zip(gradients(found, given), gradients(correct, given), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


INTERPRETED = """
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics as evaluate
from ssa_nerfstudio.rasterization import harmonics

torch.manual_seed(0)
harmonics.runs_on_current_stream = lambda device, degree: True
for degree, others in ((0, 15), (1, 15), (2, 8), (3, 15), (3, 24)):
    means, constant = torch.randn(2, 150, 3).requires_grad_().unbind()
    center, rest = torch.randn(3, requires_grad=True), torch.randn(150, others, 3, requires_grad=True)
    radii = (torch.rand(150) > 0.2).int()
    coefficients = torch.cat([constant[:, None], rest], dim=1)
    plain = (evaluate(degree, means - center, coefficients) + 0.5).clamp_min(0) * radii[:, None]
    shaded = harmonics.shade(means, center, constant, rest, radii, degree)
    torch.testing.assert_close(shaded, plain, rtol=1e-5, atol=1e-5)
    weights, leaves = torch.randn(150, 3), (means, center, constant, rest)
    found, expected = (
        torch.autograd.grad((colors * weights).sum(), leaves, allow_unused=True, materialize_grads=True)
        for colors in (shaded, plain)
    )
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)

# At the camera there is no direction, and what is not drawn has no say, whatever it holds.
means, constant, rest = torch.zeros(2, 3), torch.ones(2, 3), torch.ones(2, 15, 3)
means[1] = constant[1] = rest[1] = torch.nan
leaves = [each.requires_grad_() for each in (means, constant, rest)]
colors = harmonics.shade(means, torch.zeros(3), constant, rest, torch.tensor([1, 0], dtype=torch.int32), 3)
assert colors.isfinite().all()
for gradient in torch.autograd.grad(colors.sum(), leaves):
    assert gradient.isfinite().all()
constant.data[0, 1] = torch.nan
colors = harmonics.shade(means, torch.zeros(3), constant, rest, torch.tensor([1, 0], dtype=torch.int32), 3)
assert colors.isnan().tolist() == [[False, True, False], [False, False, False]]
print("equal")
"""


def test_tritons_kernels_are_gsplats_bases_in_its_interpreter():
    check_in_tritons_interpreter(INTERPRETED)


def test_harmonics_beyond_the_kernels_and_other_devices_are_gsplats():
    on_cuda = torch.device("cuda")
    assert harmonics.runs_on_current_stream(on_cuda, 3) == harmonics._TRITON
    assert not harmonics.runs_on_current_stream(on_cuda, 4)
    assert not harmonics.runs_on_current_stream(torch.device("cpu"), 3)
