"""The exploration noise of MCMC densification: a step of stochastic gradient Langevin dynamics."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping

import torch
from gsplat.strategy.ops import inject_noise_to_position
from torch import Tensor

_TRITON = importlib.util.find_spec("triton") is not None


@torch.no_grad()
def perturb(params: Mapping[str, Tensor], rate: float, scale: Tensor | None = None) -> None:
    """Perturb the centers of Gaussians, transparent ones most: mu += rate sigmoid(100 (0.005 - o)) Sigma eta with eta
    standard normal (3DGS as MCMC, arXiv 2404.09591).

    Two launches where Triton's kernels run; elsewhere gsplat's function, fifteen on CUDA.

    Args:
        params: means [N, 3], changed in place, quats [N, 4] (wxyz), log scales [N, 3], logit opacities [N, 1].
        rate: learning rate of the means times that of the noise.
        scale: factor of the noise, a scalar on the device; None: 1.
    """
    means = params["means"]
    if means.is_cuda and _TRITON:
        from ssa_nerfstudio.plugin.training._langevin_noise_triton import perturb_means

        normals = torch.randn_like(means)
        perturb_means(means, params["quats"], params["scales"], params["opacities"], normals, rate, scale)
        return
    scaler = rate if scale is None else rate * scale
    inject_noise_to_position(params=params, optimizers={}, state={}, scaler=scaler)  # pyright: ignore[reportArgumentType]
