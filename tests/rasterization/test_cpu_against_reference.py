"""The numba rasterizer against the plain-torch reference in float64: images and gradients."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterization_scenes import assert_cpu_agrees_with_reference, cast, scene

from benchmarks.rasterizers import random_scene

both_dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])


@both_dtypes
@pytest.mark.parametrize("seed", range(4))
def test_image_alpha_depth_and_every_gradient_agree(seed: int, dtype: torch.dtype) -> None:
    oracle = assert_cpu_agrees_with_reference(scene(300, 45, 35, seed=seed), 45, 35, dtype)
    assert {"image", "alpha", "depth", "d means", "d quats", "d scales", "d opacities", "d colors", "d means2d"} <= set(
        oracle
    )
    assert all(value.abs().max() > 0 for value in oracle.values())


@both_dtypes
@pytest.mark.parametrize("seed", range(2))
def test_a_camera_in_general_position_agrees(seed: int, dtype: torch.dtype) -> None:
    made = cast(random_scene(200, 37, 29, 0.06, torch.float32, seed), torch.float64)
    oracle = assert_cpu_agrees_with_reference(made, 37, 29, dtype)
    assert (oracle["d means"].abs().amax(dim=0) > 0).all()
    assert oracle["alpha"].max() > 0.5


@both_dtypes
@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 16), (15, 49), (1, 40), (70, 3), (33, 31)])
def test_images_of_any_size_agree(width: int, height: int, dtype: torch.dtype) -> None:
    oracle = assert_cpu_agrees_with_reference(scene(120, width, height, size=0.15), width, height, dtype)
    assert oracle["image"].shape == (1, height, width, 3)
    assert oracle["alpha"].max() > 0


@both_dtypes
def test_a_single_gaussian_agrees(dtype: torch.dtype) -> None:
    gaussians, viewmats, Ks = scene(1, 20, 18, size=0.3)
    gaussians["means"] = torch.tensor([[0.1, -0.05, 3.0]], dtype=torch.float64)
    gaussians["opacities"] = torch.tensor([0.7], dtype=torch.float64)
    oracle = assert_cpu_agrees_with_reference((gaussians, viewmats, Ks), 20, 18, dtype)
    assert oracle["alpha"].max() == pytest.approx(0.7, abs=0.01)


@both_dtypes
@pytest.mark.parametrize("sh_degree", [None, 0, 1, 2, 3])
def test_colors_and_harmonics_of_every_degree_agree(sh_degree: int | None, dtype: torch.dtype) -> None:
    made = scene(150, 37, 29, sh_degree=sh_degree, seed=5)
    assert_cpu_agrees_with_reference(made, 37, 29, dtype, sh_degree=sh_degree)


@both_dtypes
def test_a_lower_degree_than_there_are_coefficients_agrees_and_leaves_the_rest_alone(dtype: torch.dtype) -> None:
    oracle = assert_cpu_agrees_with_reference(scene(150, 37, 29), 37, 29, dtype, sh_degree=1)
    assert oracle["d colors"][:, :4].abs().max() > 0
    assert (oracle["d colors"][:, 4:] == 0).all()


@both_dtypes
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("cameras", [1, 2])
def test_every_render_mode_agrees_with_a_background(cameras: int, render_mode: str, dtype: torch.dtype) -> None:
    backgrounds = torch.tensor([[0.2, 0.9, 0.4], [0.7, 0.1, 0.5]], dtype=torch.float64)[:cameras]
    oracle = assert_cpu_agrees_with_reference(
        scene(150, 37, 29, cameras=cameras), 37, 29, dtype, render_mode=render_mode, backgrounds=backgrounds
    )
    channels = oracle["image"].shape[-1] + oracle["depth"].shape[-1]
    assert channels == {"RGB": 3, "D": 1, "ED": 1}.get(render_mode, 4)


@both_dtypes
@pytest.mark.parametrize(
    "options",
    [
        {"rasterize_mode": "antialiased"},
        {"radius_clip": 4.0},
        {"near_plane": 2.9},
        {"far_plane": 3.1},
        {"eps2d": 0.05},
    ],
    ids=lambda options: next(iter(options)),
)
def test_two_cameras_agree_with_each_option(options: dict[str, Any], dtype: torch.dtype) -> None:
    made = scene(200, 40, 27, size=0.03, cameras=2, seed=2)
    drawn = assert_cpu_agrees_with_reference(made, 40, 27, dtype, **options)
    plain = assert_cpu_agrees_with_reference(made, 40, 27, dtype)
    assert (drawn["image"] - plain["image"]).abs().max() > 0.01, "the option changed nothing"
    assert drawn["d means2d"].shape == (2, 200, 2)
    assert (drawn["d means2d"].abs().amax(dim=(1, 2)) > 0).all()


@both_dtypes
def test_opaque_gaussians_on_pixel_centers_agree_where_alpha_is_clamped(dtype: torch.dtype) -> None:
    gaussians, viewmats, Ks = scene(60, 16, 16, size=0.3, seed=3)
    gaussians["opacities"] = torch.ones(60, dtype=torch.float64)
    pixels = torch.randint(0, 16, (60, 2), generator=torch.Generator().manual_seed(0)) + 0.5
    depth = gaussians["means"][:, 2:]
    gaussians["means"] = torch.cat([(pixels - 8) / Ks[0, 0, 0] * depth, depth], dim=1)
    oracle = assert_cpu_agrees_with_reference((gaussians, viewmats, Ks), 16, 16, dtype)
    assert oracle["alpha"].max() > 0.9985


@both_dtypes
def test_degenerate_gaussians_agree(dtype: torch.dtype) -> None:
    gaussians, viewmats, Ks = scene(60, 24, 24, size=0.1, seed=6)
    gaussians["quats"][:5] = 0
    gaussians["quats"][5:10] *= 1e3
    gaussians["scales"][10:15] = 0
    gaussians["scales"][15:20, 1:] = 1e-7  # needles
    gaussians["scales"][20:22] = 5  # larger than the image
    gaussians["opacities"][22:30] = 0
    gaussians["opacities"][30:35] = 1 / 300  # below what is drawn
    oracle = assert_cpu_agrees_with_reference((gaussians, viewmats, Ks), 24, 24, dtype)
    assert (oracle["d quats"][:5] == 0).all()
    assert (oracle["d opacities"][22:35] == 0).all()


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31 - 1),
    n=st.integers(1, 120),
    width=st.integers(1, 50),
    height=st.integers(1, 50),
    size=st.sampled_from([0.003, 0.05, 0.5, 3.0]),
    focal=st.sampled_from([0.3, 1.1, 4.0]),
)
def test_any_scene_agrees_in_float64(seed: int, n: int, width: int, height: int, size: float, focal: float) -> None:
    gaussians, viewmats, Ks = scene(n, width, height, size=size, seed=seed)
    gaussians["means"][:, 2] -= 2.0  # some straddle the near plane, some are behind the camera
    Ks[:, 0, 0] *= focal
    Ks[:, 1, 1] *= 0.9 * focal
    Ks[:, 0, 2] += 0.1 * width
    assert_cpu_agrees_with_reference((gaussians, viewmats, Ks), width, height, torch.float64)
