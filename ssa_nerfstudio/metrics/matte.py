"""Mattes and layers against those of the true artifact: pure functions."""

from __future__ import annotations

import cv2
import numpy as np
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


def layer_errors(
    transmitted: np.ndarray, added: np.ndarray, true_transmitted: np.ndarray, true_added: np.ndarray
) -> dict[str, float]:
    """Learned layers against the true ones, in the learned ones' frame; truth of another size is averaged over areas.

    An artifact that adds light without hiding any (T = 1: rain) has no matte that alone would be right: of the truth
    and of what was learned, max over channels of 1 - T and B is taken, the least opacity with which A W can explain it.

    Args:
        transmitted: T [H, W, 1 or 3], learned.
        added: B = A W [H, W, 3], learned.
        true_transmitted: T [H', W', 3].
        true_added: B [H', W', 3].

    Returns:
        matte_error: mean absolute error of that; matte_iou: at 0.5; premultiplied_error: mean absolute error of A W
        against B; transmittance_error: of 1 - A against T.
    """
    size = transmitted.shape[1], transmitted.shape[0]
    truth_t, truth_b = (
        layer if layer.shape[1::-1] == size else cv2.resize(layer, size, interpolation=cv2.INTER_AREA)
        for layer in (true_transmitted, true_added)
    )
    true_matte = np.maximum(1 - truth_t, truth_b).max(axis=2).clip(0, 1)
    matte = torch.from_numpy(np.maximum(1 - transmitted[..., 0], added.max(axis=2))).clamp(0, 1)
    target = torch.from_numpy(np.ascontiguousarray(true_matte))
    return {
        "matte_error": matte_error(matte, target),
        "matte_iou": matte_iou(matte, target > 0.5),
        "premultiplied_error": float(np.abs(added - truth_b).mean()),
        "transmittance_error": float(np.abs(transmitted - truth_t).mean()),
    }
