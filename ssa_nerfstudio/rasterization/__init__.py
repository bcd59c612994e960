"""One function signature, gsplat's `rasterization`, and three bodies.

`gsplat` runs on CUDA, `cpu` is a numba splatter with a hand-written backward pass, `reference` is plain torch in any
float dtype and the oracle of the other two. `rasterizer` picks one by name, or by the device that holds the Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch

RasterizerName = Literal["auto", "gsplat", "cpu", "reference"]


def rasterizer(name: RasterizerName, device: torch.device | str) -> Callable:
    """Return the `rasterization` function of one body.

    Args:
        name: the body; `auto` means `gsplat` on CUDA and `cpu` elsewhere.
        device: where the Gaussians live.

    Returns:
        A function with the signature of `gsplat.rasterization` (the subset in `interface.rasterization_with`).

    Raises:
        ValueError: for `gsplat` off CUDA, `cpu` off the CPU, or an unknown name.
    """
    kind = torch.device(device).type
    if name == "auto":
        name = "gsplat" if kind == "cuda" else "cpu"
    if name == "gsplat":
        if kind != "cuda":
            raise ValueError(f"rasterizer 'gsplat' needs CUDA, the Gaussians are on {kind}; use 'cpu' or 'auto'")
        from ssa_nerfstudio.rasterization.cuda import rasterization

        return rasterization
    if name == "cpu":
        if kind != "cpu":
            raise ValueError(f"rasterizer 'cpu' needs the CPU, the Gaussians are on {kind}; use 'gsplat' or 'auto'")
        from ssa_nerfstudio.rasterization.cpu import rasterization

        return rasterization
    if name == "reference":
        from ssa_nerfstudio.rasterization.reference import rasterization

        return rasterization
    raise ValueError(f"unknown rasterizer {name!r}; choose auto, gsplat, cpu or reference")
