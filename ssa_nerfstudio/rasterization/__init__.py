"""Rasterization of Gaussians: gsplat's interface with three implementations.

`gsplat` runs on CUDA, `cpu` by numba kernels with a hand-written backward pass, `reference` in plain torch on any
device and in any float dtype. `rasterizer` selects one by name, or by the device that holds the Gaussians.
"""

from __future__ import annotations

from typing import Literal

import torch

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.rasterization.interface import Rasterization

RasterizerName = Literal["auto", "gsplat", "cpu", "reference"]


def rasterizer(name: RasterizerName, device: torch.device | str) -> Rasterization:
    """Select the `rasterization` function of one implementation.

    Args:
        name: of the implementation; `auto` is `gsplat` on CUDA and `cpu` elsewhere.
        device: the device that holds the Gaussians.

    Returns:
        A function with the interface of `gsplat.rasterization`, as `interface.make_rasterization` documents it.

    Raises:
        InputError: `gsplat` without CUDA, `cpu` off the CPU, or an unknown name.
    """
    kind = torch.device(device).type
    if name == "auto":
        name = "gsplat" if kind == "cuda" else "cpu"
    if name == "gsplat":
        if kind != "cuda":
            raise InputError(f"rasterizer 'gsplat' needs CUDA, the Gaussians are on {kind}", "use 'cpu' or 'auto'")
        from ssa_nerfstudio.rasterization.cuda import rasterization

        return rasterization
    if name == "cpu":
        if kind != "cpu":
            raise InputError(f"rasterizer 'cpu' needs the CPU, the Gaussians are on {kind}", "use 'gsplat' or 'auto'")
        from ssa_nerfstudio.rasterization.cpu import rasterization

        return rasterization
    if name == "reference":
        from ssa_nerfstudio.rasterization.reference import rasterization

        return rasterization
    raise InputError(f"unknown rasterizer {name!r}", "choose auto, gsplat, cpu or reference")
