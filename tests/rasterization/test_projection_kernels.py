"""The numba projection against the projection in plain torch: splats and gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterization_scenes import BODIES, TOLERANCE, Scene, cast, scene, view
from torch import Tensor

from benchmarks.rasterizers import OPTIONS, draw, relative_error
from ssa_nerfstudio.rasterization import cpu_projection, projection
from ssa_nerfstudio.rasterization.interface import Gaussians
from ssa_nerfstudio.rasterization.projection import Splats

WIDTH, HEIGHT = 40, 30
FIELDS = ("means2d", "conics", "opacities", "colors")


def project_and_pull_back(
    project: Callable[..., Splats], made: Scene, **options: Any
) -> tuple[Splats, dict[str, Tensor]]:
    """The splats of the first camera, and the gradient of every parameter for fixed random cotangents."""
    leaves = {name: value.clone().requires_grad_() for name, value in made[0].items()}
    splats = project(Gaussians(**leaves), made[1][0], made[2][0], WIDTH, HEIGHT, replace(OPTIONS, **options))
    generator = torch.Generator().manual_seed(2)
    total = torch.zeros((), dtype=made[1].dtype)
    for name in FIELDS:
        value = getattr(splats, name)
        total = total + (value * torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value)).sum()
    total.backward()
    splats = Splats(**{name: value.detach() for name, value in vars(splats).items()})
    return splats, {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def assert_projections_agree(made: Scene, dtype: torch.dtype = torch.float64, **options: Any) -> Splats:
    """Compare the kernels in `dtype` with torch in float64; returns torch's splats."""
    expected, gradients = project_and_pull_back(projection.project, made, **options)
    found, found_gradients = project_and_pull_back(cpu_projection.project, cast(made, dtype), **options)
    assert torch.equal(found.ids, expected.ids)
    assert torch.equal(found.radii, expected.radii)
    errors = {name: relative_error(getattr(found, name).double(), getattr(expected, name)) for name in FIELDS}
    errors |= {f"d {name}": relative_error(found_gradients[name].double(), gradients[name]) for name in gradients}
    assert max(errors.values()) < TOLERANCE[dtype], errors
    assert found_gradients.keys() == gradients.keys() == made[0].keys()
    return expected


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sh_degree", [None, 0, 1, 2, 3])
def test_splats_and_gradients_agree_for_colors_and_every_degree(sh_degree: int | None, dtype: torch.dtype) -> None:
    gaussians, _, Ks = scene(200, WIDTH, HEIGHT, sh_degree=sh_degree, seed=1)
    if sh_degree is not None:
        gaussians["colors"] *= 3  # so that some channels are clamped at black
    splats = assert_projections_agree((gaussians, view(0.7)[None], Ks), dtype, sh_degree=sh_degree)
    assert len(splats.ids) > 150
    assert sh_degree is None or (splats.colors[:, :3] == 0).any()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31 - 1),
    angle=st.floats(-3.1, 3.1),
    size=st.sampled_from([1e-4, 0.05, 1.0, 30.0]),
    nearer=st.floats(0, 4),
    focal=st.sampled_from([0.2, 1.0, 5.0]),
    radius_clip=st.sampled_from([0.0, 2.5, 4.0]),
)
def test_any_scene_projects_alike(
    seed: int, angle: float, size: float, nearer: float, focal: float, radius_clip: float
) -> None:
    gaussians, _, Ks = scene(40, WIDTH, HEIGHT, size=size, seed=seed)
    gaussians["means"] *= 1.5
    viewmat = view(angle)
    viewmat[2, 3] -= nearer
    Ks[:, 0, 0] *= focal
    Ks[:, 1, 1] *= 1.3 * focal
    Ks[:, 0, 2] += 5
    assert_projections_agree((gaussians, viewmat[None], Ks), radius_clip=radius_clip)


def test_off_screen_gaussians_with_clamped_linearization_agree() -> None:
    gaussians, viewmats, Ks = scene(40, WIDTH, HEIGHT, size=0.6, seed=3)
    gaussians["means"][:20, 0] = torch.linspace(2.2, 4.0, 20, dtype=torch.float64) * torch.tensor([1, -1]).repeat(10)
    gaussians["means"][20:, 1] = torch.linspace(2.0, 4.0, 20, dtype=torch.float64) * torch.tensor([1, -1]).repeat(10)
    splats = assert_projections_agree((gaussians, viewmats, Ks))
    x, y = splats.means2d.T
    beyond = torch.stack([x < -0.15 * WIDTH, x > 1.15 * WIDTH, y < -0.15 * HEIGHT, y > 1.15 * HEIGHT])
    assert (beyond.sum(dim=1) >= 2).all(), "too few are drawn from beyond each side"


def test_a_quaternion_of_zeros_means_no_rotation_and_gets_no_gradient() -> None:
    gaussians, viewmats, Ks = scene(20, WIDTH, HEIGHT, size=0.2, seed=4)
    zero, one = dict(gaussians), dict(gaussians)
    zero["quats"] = torch.zeros_like(gaussians["quats"])
    one["quats"] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(20, 1)
    assert_projections_agree((zero, viewmats, Ks))
    turned, gradients = project_and_pull_back(cpu_projection.project, (zero, viewmats, Ks))
    plain, _ = project_and_pull_back(cpu_projection.project, (one, viewmats, Ks))
    assert torch.equal(turned.conics, plain.conics)
    assert (gradients["quats"] == 0).all()


def test_the_length_of_a_quaternion_does_not_matter_and_its_gradient_is_perpendicular_to_it() -> None:
    gaussians, viewmats, Ks = scene(30, WIDTH, HEIGHT, size=0.2, seed=5)
    longer = {**gaussians, "quats": 7 * gaussians["quats"]}
    splats, gradients = project_and_pull_back(cpu_projection.project, (gaussians, viewmats, Ks))
    same, scaled = project_and_pull_back(cpu_projection.project, (longer, viewmats, Ks))
    torch.testing.assert_close(same.conics, splats.conics, rtol=1e-12, atol=0)
    torch.testing.assert_close(7 * scaled["quats"], gradients["quats"], rtol=1e-9, atol=1e-12)
    along = (gradients["quats"] * gaussians["quats"]).sum(dim=1)
    assert along.abs().max() < 1e-10 * gradients["quats"].abs().max()


def test_splats_come_nearest_first_and_equal_depths_in_order_of_their_index() -> None:
    gaussians, viewmats, Ks = scene(60, WIDTH, HEIGHT, seed=6)
    gaussians["means"][:, 2] = (gaussians["means"][:, 2] * 4).round() / 4
    splats = assert_projections_agree((gaussians, viewmats, Ks))
    keys = [(gaussians["means"][i, 2].item(), i) for i in splats.ids.tolist()]
    assert keys == sorted(keys)
    assert len({depth for depth, _ in keys}) < len(keys)


@pytest.mark.parametrize("name", ["viewmats", "Ks"])
def test_a_camera_that_is_optimized_gets_its_gradient_from_the_cpu_rasterizer(name: str) -> None:
    gaussians, viewmats, Ks = scene(80, WIDTH, HEIGHT, cameras=2, seed=7)
    gradients = {}
    for body, rasterization in BODIES.items():
        camera = {"viewmats": viewmats.clone(), "Ks": Ks.clone()}
        camera[name].requires_grad_()
        draw(rasterization, gaussians, camera["viewmats"], camera["Ks"], WIDTH, HEIGHT)
        gradients[body] = camera[name].grad
    assert (gradients["reference"].flatten(1).abs().amax(dim=1) > 0).all()
    assert relative_error(gradients["cpu"], gradients["reference"]) < 1e-10


def test_harmonics_of_the_fourth_degree_agree() -> None:
    gaussians, viewmats, Ks = scene(50, WIDTH, HEIGHT, seed=8)
    higher = 0.2 * torch.randn(50, 9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    gaussians["colors"] = torch.cat([gaussians["colors"], higher], dim=1)
    fourth = assert_projections_agree((gaussians, viewmats, Ks), sh_degree=4)
    third = assert_projections_agree((gaussians, viewmats, Ks), sh_degree=3)
    assert (fourth.colors - third.colors).abs().max() > 0.01


def test_the_antialiased_mode_scales_opacities_as_torch_does() -> None:
    made = scene(50, WIDTH, HEIGHT, size=0.01, seed=9)
    weakened = assert_projections_agree(made, antialiased=True)
    plain = assert_projections_agree(made)
    assert (weakened.opacities < 0.5 * plain.opacities).any()
