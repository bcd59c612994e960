"""gsplat's blending, whose gradient is taken by hand: that each gradient belongs to what it is of.

On a CPU sums stand in for gsplat's two kernels; `tests/plugin/test_splat_rendering.py` compares the kernels on CUDA.
"""

from __future__ import annotations

import pytest
import torch
from gsplat.cuda import _wrapper
from torch import Tensor

from ssa_nerfstudio.rasterization import cuda
from ssa_nerfstudio.rasterization.interface import Cameras, RenderOptions

WIDTH, HEIGHT, N = 20, 12, 5


def weighted(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """A picture on which each argument has an effect of its own."""
    light = (colors * opacities[..., None]).sum(dim=1) + means2d.square().sum()
    image = light[:, None, None] * torch.linspace(0.5, 1.0, WIDTH)[:, None] + conics.sum()
    return image.expand(1, HEIGHT, WIDTH, 3), (opacities.sum() * means2d.sum()).expand(1, HEIGHT, WIDTH, 1)


def forward(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, *rest) -> tuple[Tensor, ...]:
    assert rest == (None, None, WIDTH, HEIGHT, 16, "offsets", "ids")
    return *weighted(means2d, conics, colors, opacities), torch.zeros(1)


def backward(means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, *rest) -> tuple[Tensor, ...]:
    *_, of_image, of_alpha, absgrad = rest
    assert absgrad
    leaves = [each.detach().requires_grad_() for each in (means2d, conics, colors, opacities)]
    with torch.enable_grad():
        picture = weighted(*leaves)
    found = torch.autograd.grad(picture, leaves, [of_image, of_alpha])
    return found[0].abs(), *found


@pytest.mark.parametrize("slope", [1.0, -2.0])
def test_each_gradient_is_that_of_autograd(monkeypatch, slope):
    kernels = {"rasterize_to_pixels_fwd": forward, "rasterize_to_pixels_bwd": backward}
    monkeypatch.setattr(_wrapper, "_make_lazy_cuda_func", kernels.__getitem__)
    monkeypatch.setattr(cuda, "tile_lists", lambda *_: ("offsets", "ids"))
    generator = torch.Generator().manual_seed(0)
    shapes = ((1, N, 2), (1, N, 3), (1, N), (1, N), (1, N), (1, N, 3))
    means2d, conics, alphas, depths, radii, channels = (torch.rand(shape, generator=generator) for shape in shapes)
    projected = cuda.Projected(means2d.requires_grad_(), conics, alphas, depths, radii.int())
    cameras = Cameras(torch.eye(4)[None], torch.eye(3)[None], WIDTH, HEIGHT, None)
    options = RenderOptions(0.01, 1e10, 0.0, 0.3, None, "RGB", absgrad=True, antialiased=False)

    blending = cuda.Blending(projected, channels, cameras, options)
    assert blending.image.requires_grad
    assert blending.alpha.requires_grad
    of_image = slope * torch.rand(1, HEIGHT, WIDTH, 3, generator=generator)
    of_alpha = slope * torch.rand(1, HEIGHT, WIDTH, 1, generator=generator)
    found = blending.backpropagate(of_image, of_alpha)

    leaves = [each.detach().requires_grad_() for each in (means2d, conics, channels, alphas)]
    picture = weighted(*leaves)
    torch.testing.assert_close([blending.image, blending.alpha], list(picture))
    of_means2d, of_conics, of_channels, of_alphas = torch.autograd.grad(picture, leaves, [of_image, of_alpha])
    expected = [of_means2d, of_conics, of_alphas, None, None, of_channels]
    assert [each is None for each in found] == [each is None for each in expected]
    for mine, true in zip(found, expected, strict=True):
        if true is not None:
            torch.testing.assert_close(mine, true)
    assert projected.means2d.grad is found[0]
    torch.testing.assert_close(projected.means2d.absgrad, of_means2d.abs())  # pyright: ignore[reportAttributeAccessIssue]
