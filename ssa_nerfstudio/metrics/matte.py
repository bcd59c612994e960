"""Matte metrics against the true artifact: pure functions on torch tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from ssa_nerfstudio.metrics.image import checked_unit_range


def matte_iou(alpha: Tensor, mask: Tensor, threshold: float = 0.5) -> float:
    """Intersection over union of a thresholded matte and the true mask.

    Args:
        alpha: matte A [H, W], floating point, in [0, 1].
        mask: true artifact mask [H, W], bool.
        threshold: a pixel counts as artifact where alpha > threshold; in [0, 1).

    Returns:
        A number in [0, 1]; 1 where both are empty.

    Raises:
        ValueError: alpha is not a finite floating-point [H, W] in [0, 1], mask is not bool or of another shape,
            or the threshold is out of range.
    """
    alpha = checked_unit_range(alpha, "alpha", 2)
    if mask.dtype != torch.bool or mask.shape != alpha.shape:
        raise ValueError(f"mask must be bool {tuple(alpha.shape)}, got {mask.dtype} {tuple(mask.shape)}")
    if not 0 <= threshold < 1:
        raise ValueError(f"threshold must be in [0, 1), got {threshold}")
    found, true = alpha > threshold, mask.to(alpha.device)
    union = (found | true).sum().item()
    return 1.0 if union == 0 else (found & true).sum().item() / union


def matte_error(alpha: Tensor, target: Tensor) -> float:
    """Mean absolute error between two mattes.

    Args:
        alpha: matte A [H, W], floating point, in [0, 1].
        target: true matte [H, W], same range.

    Returns:
        A number in [0, 1].

    Raises:
        ValueError: a matte is not a finite floating-point [H, W] in [0, 1], or the shapes differ.
    """
    alpha, target = checked_unit_range(alpha, "alpha", 2), checked_unit_range(target, "target", 2)
    if alpha.shape != target.shape:
        raise ValueError(f"alpha {tuple(alpha.shape)} and target {tuple(target.shape)} differ in shape")
    return (alpha - target.to(alpha.device)).abs().mean().item()
