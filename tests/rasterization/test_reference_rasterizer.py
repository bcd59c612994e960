"""The reference itself: against the formulas written out for one pixel at a time, and against finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterization_scenes import BODIES, Scene, scene, view
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.rasterizers import OPTIONS
from ssa_nerfstudio.rasterization import constants, reference
from ssa_nerfstudio.rasterization.interface import Gaussians
from ssa_nerfstudio.rasterization.projection import project


def draw_pixel_by_pixel(
    made: Scene, width: int, height: int, antialiased: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Color, depth, alpha by gsplat's formulas in numpy, and the number of pixels where the transmittance ran out."""
    gaussians = {name: value.numpy() for name, value in made[0].items()}
    viewmat, K = made[1][0].numpy(), made[2][0].numpy()
    splats = []
    for mean, quat, scale, opacity, color in zip(*gaussians.values(), strict=True):
        x, y, z = viewmat[:3, :3] @ mean + viewmat[:3, 3]
        if not constants.NEAR_PLANE < z < constants.FAR_PLANE:
            continue
        turned = viewmat[:3, :3] @ Rotation.from_quat(np.roll(quat, -1)).as_matrix() @ np.diag(scale)
        margin = 0.15 * np.array([width, height])  # beyond it the projection is linearised at the margin
        reach = np.array([-margin, margin + np.array([width, height])]) - K[:2, 2]
        u, v = np.clip([K[0, 0] * x / z, K[1, 1] * y / z], *reach)
        jacobian = np.array([[K[0, 0] / z, 0, -u / z], [0, K[1, 1] / z, -v / z]])
        sharp = jacobian @ turned @ turned.T @ jacobian.T
        covariance = sharp + constants.EPS2D * np.eye(2)
        if antialiased:
            opacity = opacity * math.sqrt(np.linalg.det(sharp) / np.linalg.det(covariance))
        center = np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
        spread = max(0.1, 0.5 * np.diff(np.linalg.eigvalsh(covariance))[0])
        half = math.ceil(3 * math.sqrt(0.5 * np.trace(covariance) + spread))
        if (center + half <= 0).any() or (center - half >= (width, height)).any():
            continue
        splats.append((z, center, half, np.linalg.inv(covariance), opacity, color))
    splats.sort(key=lambda splat: splat[0])
    stopped = 0
    image, depth, alphas = np.zeros((height, width, 3)), np.zeros((height, width)), np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            transmittance = 1.0
            tile = np.array([column // 16, row // 16])
            for z, center, half, inverse, opacity, color in splats:
                if (np.floor((center - half) / 16) > tile).any() or (np.ceil((center + half) / 16) <= tile).any():
                    continue
                offset = np.array([column + 0.5, row + 0.5]) - center
                alpha = min(0.999, opacity * math.exp(-0.5 * offset @ inverse @ offset))
                if alpha < 1 / 255:
                    continue
                if transmittance * (1 - alpha) <= 1e-4:
                    stopped += 1
                    break
                image[row, column] += transmittance * alpha * color
                depth[row, column] += transmittance * alpha * z
                transmittance *= 1 - alpha
            alphas[row, column] = 1 - transmittance
    return image, depth, alphas, stopped


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", BODIES)
def test_each_body_draws_what_the_formulas_say(name: str, antialiased: bool) -> None:
    width, height = 35, 18
    gaussians, _, Ks = scene(40, width, height, size=0.3, sh_degree=None, seed=11)
    gaussians["opacities"][:30] = 1.0
    gaussians["means"][:10, 2] -= 3.0  # near or behind the camera
    viewmats = view(0.5)[None]
    image, depth, alphas, stopped = draw_pixel_by_pixel((gaussians, viewmats, Ks), width, height, antialiased)
    render, alpha, _ = BODIES[name](
        **gaussians, viewmats=viewmats, Ks=Ks, width=width, height=height, render_mode="RGB+D",
        rasterize_mode="antialiased" if antialiased else "classic",
    )  # fmt: skip
    np.testing.assert_allclose(render[0, ..., :3].numpy(), image, atol=1e-12)
    np.testing.assert_allclose(render[0, ..., 3].numpy(), depth, atol=1e-12)
    np.testing.assert_allclose(alpha[0, ..., 0].numpy(), alphas, atol=1e-12)
    assert stopped > 0
    assert alphas.min() < 0.5


@pytest.mark.parametrize("gap", [0.0, 0.05])
@pytest.mark.parametrize("side", [(1, 0), (-1, 0), (0, 1), (0, -1)], ids=["right", "left", "below", "above"])
@pytest.mark.parametrize("name", BODIES)
def test_a_splat_ends_with_the_last_tile_that_its_three_sigma_square_touches(
    name: str, side: tuple[int, int], gap: float
) -> None:
    size, radius = 64, 22
    _, viewmats, _ = scene(1, size, size)
    Ks = torch.tensor([[[64, 0, 32], [0, 64, 32], [0, 0, 1]]], dtype=torch.float64)
    center = 32 - (radius + gap) * np.array(side)  # the square ends (just) before the middle, where a tile begins
    one = torch.ones(1, 3, dtype=torch.float64)
    gaussians = {
        "means": torch.tensor([[*(center - 32) / 16, 4]], dtype=torch.float64),  # 16 pixels are a unit there
        "quats": torch.tensor([[1, 0, 0, 0]], dtype=torch.float64),
        "scales": torch.tensor([[7 / 16, 7 / 16, 0]], dtype=torch.float64),
        "opacities": one[:, 0],
        "colors": one,
    }
    image, _, alphas, _ = draw_pixel_by_pixel((gaussians, viewmats, Ks), size, size, antialiased=False)
    render, _, info = BODIES[name](**gaussians, viewmats=viewmats, Ks=Ks, width=size, height=size)
    assert info["radii"].item() == radius
    np.testing.assert_allclose(render[0].numpy(), image, atol=1e-12)
    x, y = center
    rows, columns = np.indices((size, size)) + 0.5
    everywhere = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * (7**2 + 0.3)))
    assert ((everywhere > 1 / 255) & (alphas == 0)).any(), "nothing is cut off"


def smooth_scene(width: int, height: int) -> Scene:
    """Three Gaussians wider than the image; all alphas, transmittances and colors are away from the cut-offs."""
    gaussians, _, Ks = scene(3, width, height, size=1.6, seed=4, sh_degree=1)
    gaussians["opacities"] = 0.3 + 0.4 * gaussians["opacities"]
    gaussians["colors"] = 0.3 * gaussians["colors"]
    viewmats = view(0.3)[None]
    splats = project(Gaussians(**gaussians), viewmats[0], Ks[0], width, height, replace(OPTIONS, sh_degree=1))
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = x[None] - splats.means2d[:, 0, None, None], y[None] - splats.means2d[:, 1, None, None]
    xx, xy, yy = (splats.conics[:, k, None, None] for k in range(3))
    alphas = splats.opacities[:, None, None] * torch.exp(-0.5 * (xx * dx**2 + yy * dy**2) - xy * dx * dy)
    assert len(splats.ids) == 3
    assert alphas.min() > 2 / 255
    assert alphas.max() < 0.9
    assert (1 - alphas).prod(dim=0).min() > 1e-3
    assert splats.colors[:, :3].min() > 0.01
    return gaussians, viewmats, Ks


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("name", BODIES)
def test_gradients_of_each_body_are_those_of_finite_differences(name: str, rasterize_mode: str) -> None:
    width, height = 4, 3
    gaussians, viewmats, Ks = smooth_scene(width, height)
    leaves = [value.clone().requires_grad_() for value in gaussians.values()]
    background = torch.tensor([[0.3, 0.6, 0.1]], dtype=torch.float64, requires_grad=True)

    def render(*inputs: Tensor) -> tuple[Tensor, Tensor]:
        image, alpha, _ = BODIES[name](
            *inputs[:5], viewmats, Ks, width, height, sh_degree=1, render_mode="RGB+ED", backgrounds=inputs[5],
            rasterize_mode=rasterize_mode,
        )  # fmt: skip
        return image, alpha

    assert torch.autograd.gradcheck(render, (*leaves, background), eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("name", BODIES)
def test_gradients_of_the_camera_are_those_of_finite_differences(name: str) -> None:
    width, height = 4, 3
    gaussians, viewmats, Ks = smooth_scene(width, height)

    def render(viewmats: Tensor, Ks: Tensor) -> tuple[Tensor, Tensor]:
        image, alpha, _ = BODIES[name](
            **gaussians, viewmats=viewmats, Ks=Ks, width=width, height=height, sh_degree=1, render_mode="RGB+ED"
        )
        return image, alpha

    inputs = viewmats.clone().requires_grad_(), Ks.clone().requires_grad_()
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-7, rtol=1e-5)


def test_the_reference_refuses_absgrad() -> None:
    gaussians, viewmats, Ks = scene(3, 8, 8)
    with pytest.raises(ValueError, match="absgrad"):
        reference.rasterization(**gaussians, viewmats=viewmats, Ks=Ks, width=8, height=8, sh_degree=3, absgrad=True)
