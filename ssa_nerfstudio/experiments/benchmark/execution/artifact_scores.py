"""How well the artifact itself came out: the learned overlay against the true layers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from ssa_nerfstudio.metrics.matte import matte_error, matte_iou
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay


def true_layers(path: Path, camera: int, cameras: int) -> tuple[np.ndarray, np.ndarray]:
    """T and B [H, W, 3] of one camera, from a simulated dataset's `layers/undistorted.npz`."""
    suffix = str(camera) if cameras > 1 else ""
    with np.load(path) as arrays:
        return arrays[f"T{suffix}"], arrays[f"B{suffix}"]


@torch.no_grad()
def score(overlay: ScreenSpaceOverlay, transmittance: np.ndarray, addition: np.ndarray) -> dict[str, float]:
    """Scores in the overlay's frame; truth of another size is averaged over areas.

    An artifact that adds light without hiding any (T = 1: rain) has no matte that alone would be right: of the truth
    and of what was learned, max over channels of 1 - T and B is taken, the least opacity with which A W can explain it.

    Args:
        overlay: what was learned.
        transmittance, addition: the truth [H, W, 3].

    Returns:
        matte_error: mean absolute error of that; matte_iou: at 0.5; premultiplied_error: mean absolute error of A W
        against B; transmittance_error: of 1 - A against T.
    """
    transmitted, added = (layer.cpu().numpy() for layer in overlay.layers())
    size = transmitted.shape[1], transmitted.shape[0]
    truth_t, truth_b = (
        layer if layer.shape[1::-1] == size else cv2.resize(layer, size, interpolation=cv2.INTER_AREA)
        for layer in (transmittance, addition)
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
