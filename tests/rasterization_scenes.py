"""Scenes and comparisons for tests of the rasterizers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from benchmarks.rasterizers import draw, random_scene, relative_error
from ssa_nerfstudio.rasterization import cpu, reference

Scene = tuple[dict[str, Tensor], Tensor, Tensor]
BODIES = {"cpu": cpu.rasterization, "reference": reference.rasterization}
TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-10}


def scene(
    n: int,
    width: int,
    height: int,
    *,
    size: float = 0.06,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    sh_degree: int | None = 3,
    cameras: int = 1,
) -> Scene:
    """`random_scene`, its cube around (0, 0, 3), seen by cameras around it; numbers that float32 holds exactly.

    No more color coefficients than `sh_degree` needs; camera 0 is the identity.
    """
    gaussians, viewmats, Ks = random_scene(n, width, height, size, dtype, seed)
    in_camera = gaussians["means"] @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
    gaussians["means"] = in_camera.float().to(dtype)
    colors = gaussians["colors"]
    gaussians["colors"] = colors[:, 0].abs() if sh_degree is None else colors[:, : (sh_degree + 1) ** 2].contiguous()
    viewmats = torch.stack([view(0.4 * camera, dtype) for camera in range(cameras)])
    return gaussians, viewmats, Ks.repeat(cameras, 1, 1)


def view(angle: float, dtype: torch.dtype = torch.float64) -> Tensor:
    """World to camera [4, 4]: three units from (0, 0, 3), which stays in the middle, turned and rolled by an angle."""
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=dtype)
    roll = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=dtype)
    matrix = torch.eye(4, dtype=dtype)
    matrix[:3, :3] = roll @ turn
    middle = torch.tensor([0, 0, 3], dtype=dtype)
    matrix[:3, 3] = middle - matrix[:3, :3] @ middle
    return matrix


def cast(made: Scene, dtype: torch.dtype) -> Scene:
    """The same scene in another precision."""
    gaussians, viewmats, Ks = made
    return {name: value.to(dtype) for name, value in gaussians.items()}, viewmats.to(dtype), Ks.to(dtype)


def assert_cpu_agrees_with_reference(
    made: Scene, width: int, height: int, dtype: torch.dtype, **options
) -> dict[str, Tensor]:
    """Draw on the cpu in `dtype` and compare image, alpha, depth and every gradient with the reference in float64."""
    backgrounds = options.pop("backgrounds", None)
    wide, narrow = (
        {} if backgrounds is None else {"backgrounds": backgrounds.to(kind)} for kind in (torch.float64, dtype)
    )
    oracle = draw(reference.rasterization, *cast(made, torch.float64), width, height, **options, **wide)
    drawn = draw(cpu.rasterization, *cast(made, dtype), width, height, **options, **narrow)
    assert drawn.keys() == oracle.keys()
    errors = {name: relative_error(drawn[name], oracle[name]) for name in oracle}
    assert all(drawn[name].isfinite().all() for name in drawn)
    assert max(errors.values()) < TOLERANCE[dtype], errors
    return oracle


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch, and with it the kernels, run on so many threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
