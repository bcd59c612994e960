"""Repairs of gsplat 1.4.0."""

from __future__ import annotations

import math
from functools import cache

import gsplat.strategy.ops
import torch
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci
from gsplat.cuda._wrapper import _make_lazy_cuda_func
from torch import Tensor


@cache
def repair_mcmc() -> None:
    """Give gsplat's MCMC strategy torch implementations of its two CUDA kernels, chosen by the tensors' device, and on
    CUDA the relocation's kernel alone.

    gsplat's wrapper of that kernel also fills a table of binomials that nothing reads, in 1326 writes to the device: 17
    ms, twice a refinement (gsplat/relocation.py:40).

    Called when an MCMC strategy is made, not at import. May go when gsplat ships CPU bodies
    (https://github.com/nerfstudio-project/gsplat/issues/635) and drops the table.
    """
    ops = gsplat.strategy.ops
    cuda_covariance = ops.quat_scale_to_covar_preci

    def compute_relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor):
        body = _relocated_on_cuda if opacities.is_cuda else relocated
        return body(opacities, scales, ratios, binoms)

    def quat_scale_to_covar_preci(quats: Tensor, scales: Tensor, *args, **kwargs):
        body = cuda_covariance if quats.is_cuda else _quat_scale_to_covar_preci
        return body(quats, scales, *args, **kwargs)

    ops.compute_relocation = compute_relocation
    ops.quat_scale_to_covar_preci = quat_scale_to_covar_preci


def _relocated_on_cuda(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """`relocated` by gsplat's kernel."""
    kernel = _make_lazy_cuda_func("compute_relocation")
    counts = ratios.clamp(1, len(binoms)).int()
    return kernel(opacities.contiguous(), scales.contiguous(), counts.contiguous(), binoms, len(binoms))


def relocated(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale of each of n Gaussians that take the place of one (3DGS as MCMC, arXiv 2404.09591, equation 9).

    o' = 1 - (1 - o)^(1 / n) and s' = s o / sum_{i=1..n} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1),
    summed in float64, where the alternating terms of n = 51 still cancel to a usable result.

    Args:
        opacities: [N] or [N, 1] in (0, 1).
        scales: [N, 3].
        ratios: [N], how many Gaussians share the place; clamped to [1, len(binoms)].
        binoms: [n_max, n_max] with binoms[n, k] = C(n, k).
    """
    o = opacities.flatten().to(torch.float64)
    n = ratios.clamp(1, binoms.shape[0])
    new = 1.0 - (1.0 - o) ** (1.0 / n.to(torch.float64))
    k = torch.arange(int(n.max()) if n.numel() else 1, device=o.device)
    terms = (-1.0) ** k * new[:, None] ** (k + 1) / (k + 1.0).sqrt()  # [N, n_max]
    # sum_{i=k+1..n} C(i-1, k) = C(n, k+1)
    weights = torch.tensor([[math.comb(m, j + 1) for j in k.tolist()] for m in range(len(k) + 1)], dtype=torch.float64)
    denominator = (weights.to(o.device)[n] * terms).sum(dim=-1)
    new_scales = scales.to(torch.float64) * (o / denominator)[:, None]
    return new.to(opacities.dtype).reshape(opacities.shape), new_scales.to(scales.dtype)
