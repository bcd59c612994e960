"""What nerfstudio 1.1.5 and gsplat 1.4.0 need mended: a function a repair, with its reason and the day it may go."""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from typing import Any

import gsplat.strategy.ops
import numpy as np
import torch
import torchmetrics.image.lpip
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci
from nerfstudio.utils import install_checks
from torch import Tensor


def allow_checkpoint_scalars() -> None:
    """Let `torch.load` of torch >= 2.6 read nerfstudio's checkpoints, which hold numpy scalars of the schedulers.

    Without it `ns-eval`, `ns-render`, `ns-export`, `ns-viewer` and resuming fail with "Weights only load failed".
    https://github.com/nerfstudio-project/nerfstudio/issues/3683; may go when nerfstudio saves plain floats.
    """
    if not hasattr(torch.serialization, "add_safe_globals"):
        return
    reconstruct = np.float64(0).__reduce__()[0]
    allowed: list[Any] = [
        reconstruct,
        # numpy 2 renamed the module; checkpoints written under the other major version name it the other way.
        (reconstruct, "numpy.core.multiarray.scalar"),
        (reconstruct, "numpy._core.multiarray.scalar"),
        np.dtype,
        *{type(np.dtype(kind)) for kind in (np.float32, np.float64, np.int32, np.int64, np.bool_)},
    ]
    torch.serialization.add_safe_globals(allowed)


def bring_ffmpeg() -> None:
    """Let `ns-render` find an ffmpeg, which it demands even where it writes images: the one of `imageio-ffmpeg`.

    Looked for only when nerfstudio asks, and not where the system has one. May go when `ns-render` asks for it only
    for videos.
    """
    check = install_checks.check_ffmpeg_installed

    def check_ffmpeg_installed() -> None:
        if shutil.which("ffmpeg") is None and importlib.util.find_spec("imageio_ffmpeg"):
            import imageio_ffmpeg

            folder = tempfile.mkdtemp(prefix="ssa-ffmpeg-")
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            os.symlink(imageio_ffmpeg.get_ffmpeg_exe(), os.path.join(folder, "ffmpeg"))
            os.environ["PATH"] = os.pathsep.join([folder, os.environ.get("PATH", "")])
        check()

    install_checks.check_ffmpeg_installed = check_ffmpeg_installed


@contextlib.contextmanager
def without_lpips() -> Iterator[None]:
    """Build a splatfacto model without LPIPS, whose constructor downloads AlexNet's weights and fails offline.

    Not used in a render path: the model is built in the main thread before a viewer exists. May go when splatfacto
    builds its metrics only where it evaluates.
    """
    original = torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity

    class _NoLpips(torch.nn.Module):
        def __init__(self, **_) -> None:
            super().__init__()

    torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = _NoLpips
    try:
        yield
    finally:
        torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = original


def give_mcmc_a_cpu_body() -> None:
    """Let gsplat's MCMC strategy run on a CPU: its two CUDA kernels get torch bodies, chosen by the tensors' device.

    May go when gsplat ships them (https://github.com/nerfstudio-project/gsplat/issues/635).
    """
    ops = gsplat.strategy.ops
    cuda_relocation, cuda_covariance = ops.compute_relocation, ops.quat_scale_to_covar_preci

    def compute_relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor):
        if opacities.is_cuda:
            return cuda_relocation(opacities, scales, ratios, binoms)
        return relocated(opacities, scales, ratios, binoms)

    def quat_scale_to_covar_preci(quats: Tensor, scales: Tensor, *args, **kwargs):
        body = cuda_covariance if quats.is_cuda else _quat_scale_to_covar_preci
        return body(quats, scales, *args, **kwargs)

    ops.compute_relocation = compute_relocation
    ops.quat_scale_to_covar_preci = quat_scale_to_covar_preci


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
