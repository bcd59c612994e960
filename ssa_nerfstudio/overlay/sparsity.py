"""The sparsity loss: what keeps scene and exposure out of the overlay. A mean over pixels."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

Sparsity = Literal["l1", "log", "off"]

MAX_WEIGHT = 0.02
"""Largest weight of the term, where none is stated; see `sparsity_weight`."""
LOG_SOFTNESS = 0.1
"""e of the concave penalty log(1 + A / e): like l1 below this opacity, lenient on opaque pixels above it."""
LOG_EVIDENCE_FLOOR = 0.1
"""Share of the concave penalty that a pixel pays even where the artifact is known."""


def sparsity_loss(matte: Tensor, evidence: Tensor, kind: Sparsity) -> Tensor:
    """Penalize the matte.

    `l1` is the paper's mean_u A(u). `log` is mean_u (0.1 + 0.9 r(u)) log(1 + A / e) / log(1 + 1 / e) with e = 0.1: it
    penalizes a faint, wide matte (an exposure layer) most, and what is opaque, or was found before, least.

    Args:
        matte: A [h, w, 1] in [0, 1].
        evidence: r [h, w, 1] in [0, 1], small where the artifact was found (`ScreenSpaceOverlay.evidence`).
        kind: `l1`, `log`, or `off`, which is zero.

    Returns:
        A scalar in [0, 1].

    Raises:
        ValueError: there is no such term.
    """
    if kind == "off":
        return matte.new_zeros(())
    if kind == "l1":
        return matte.mean()
    if kind == "log":
        return _LogSparsity.apply(matte, evidence)  # pyright: ignore[reportReturnType]
    raise ValueError(f"unknown sparsity term {kind!r}; choose l1, log or off")


def sparsity_weight(noise: Tensor) -> Tensor:
    """Weight of the sparsity loss: the photos' noise, at most MAX_WEIGHT.

    The photometric loss is a mean of absolute differences. As a likelihood (Laplace's), it is divided by their scale,
    so that a prior that is to mean the same behind any photos weighs as much as they deviate. A weight beyond the noise
    pulls thin parts of an artifact towards clear, against what the photos say.

    Args:
        noise: deviation of the photos from what is predicted of them, [] in (0, 1].

    Returns:
        [].
    """
    return noise.clamp_max(MAX_WEIGHT)


class _LogSparsity(torch.autograd.Function):
    """mean (f + (1 - f) r) log(1 + A / e) / log(1 + 1 / e).

    The gradient is by hand: nine kernel launches instead of autograd's fourteen, and a step waits for its launches.
    """

    @staticmethod
    def forward(ctx, matte: Tensor, evidence: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        weight = torch.rsub(evidence, LOG_EVIDENCE_FLOOR, alpha=LOG_EVIDENCE_FLOOR - 1.0)
        ctx.save_for_backward(matte, weight)
        penalty = torch.special.xlog1py(weight, matte * (1.0 / LOG_SOFTNESS))
        return penalty.mean() * (1.0 / math.log1p(1.0 / LOG_SOFTNESS))

    @staticmethod
    @once_differentiable
    def backward(ctx, v: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        matte, weight = ctx.saved_tensors
        scale = v * (1.0 / (matte.numel() * math.log1p(1.0 / LOG_SOFTNESS)))
        return scale * (weight / (matte + LOG_SOFTNESS)), None
