"""The noise of MCMC: a step of stochastic gradient Langevin dynamics."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping

import torch
from gsplat.strategy.ops import inject_noise_to_position
from torch import Tensor

_TRITON = importlib.util.find_spec("triton") is not None


@torch.no_grad()
def perturb(params: Mapping[str, Tensor], rate: float, skipped: Tensor | None) -> None:
    """Move Gaussians at random, transparent ones most, along what they cover (3DGS as MCMC, arXiv 2404.09591,
    equations 8 and 9): mu += rate sigmoid(100 (0.005 - o)) Sigma eta, eta standard normal.

    Where Triton's kernels run it takes two launches instead of fifteen; elsewhere it is gsplat's.

    Args:
        params: means [N, 3], changed in place, quats [N, 4] (wxyz), log scales [N, 3], logit opacities [N, 1].
        rate: the learning rate of the means times the noise's.
        skipped: one number; where it is 1, nothing moves. None: everything moves.
    """
    means = params["means"]
    if means.is_cuda and _TRITON:
        from ssa_nerfstudio.plugin.training._langevin_noise_triton import move

        move(means, params["quats"], params["scales"], params["opacities"], torch.randn_like(means), rate, skipped)
        return
    scaler = rate if skipped is None else torch.rsub(skipped, rate, alpha=rate)  # rate (1 - skipped), in one kernel
    inject_noise_to_position(params=params, optimizers={}, state={}, scaler=scaler)  # pyright: ignore[reportArgumentType]
