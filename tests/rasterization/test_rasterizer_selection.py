"""Selection of a rasterizer by name and device, and the argument checks that all bodies share."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from rasterization_scenes import BODIES, scene

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.rasterization import cuda, rasterizer


def test_auto_is_the_cpu_body_on_a_cpu_and_gsplat_on_cuda() -> None:
    assert rasterizer("auto", "cpu") is BODIES["cpu"]
    assert rasterizer("auto", torch.device("cpu")) is BODIES["cpu"]
    assert rasterizer("auto", "cuda:1") is cuda.rasterization


def test_a_body_is_selected_by_its_name() -> None:
    assert rasterizer("cpu", "cpu") is BODIES["cpu"]
    assert rasterizer("gsplat", "cuda") is rasterizer("auto", "cuda")
    assert rasterizer("reference", "cpu") is BODIES["reference"]
    assert rasterizer("reference", "cuda") is BODIES["reference"]


@pytest.mark.parametrize(
    ("name", "device", "message"),
    [
        ("gsplat", "cpu", "needs CUDA, the Gaussians are on cpu; use 'cpu' or 'auto'"),
        ("cpu", "cuda", "needs the CPU, the Gaussians are on cuda; use 'gsplat' or 'auto'"),
        ("triangles", "cpu", "unknown rasterizer 'triangles'; choose auto, gsplat, cpu or reference"),
    ],
)
def test_an_impossible_selection_names_the_remedy(name: Any, device: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        rasterizer(name, device)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("option", [{"packed": True}, {"sparse_grad": True}, {"tile_size": 8}], ids=str)
def test_unsupported_options_are_refused(name: str, option: dict[str, Any]) -> None:
    gaussians, viewmats, Ks = scene(3, 8, 8)
    with pytest.raises(ValueError, match="are not supported"):
        BODIES[name](**gaussians, viewmats=viewmats, Ks=Ks, width=8, height=8, sh_degree=3, **option)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize(
    ("shape", "sh_degree"), [((3, 3), 0), ((3, 16, 3), None), ((3, 4), None), ((3, 16, 4), 3)], ids=str
)
def test_colors_of_another_shape_are_refused(name: str, shape: tuple[int, ...], sh_degree: int | None) -> None:
    gaussians, viewmats, Ks = scene(3, 8, 8)
    gaussians["colors"] = torch.zeros(shape, dtype=torch.float64)
    with pytest.raises(ValueError, match="together with sh_degree"):
        BODIES[name](**gaussians, viewmats=viewmats, Ks=Ks, width=8, height=8, sh_degree=sh_degree)
