"""Overlays as RGBA images for display."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio.overlay.resampling import straight_color

_LIGHT, _DARK = 0.5, 0.35


def over_checkerboard(color: Tensor, alpha: Tensor, side: int = 8) -> Tensor:
    """Composite a straight-alpha image over a gray checkerboard, which shows its transparency.

    Args:
        color: [H, W, 3] in [0, 1].
        alpha: [H, W, 1] in [0, 1].
        side: of a square, pixels.

    Returns:
        [H, W, 3] in [0, 1].
    """
    rows = torch.arange(color.shape[0], device=color.device)[:, None] // side
    columns = torch.arange(color.shape[1], device=color.device) // side
    board = _DARK + (_LIGHT - _DARK) * ((rows + columns) % 2 == 0)[..., None].to(color.dtype)
    return alpha * color + (1.0 - alpha) * board


def to_rgba8(transmittance: Tensor, addition: Tensor) -> np.ndarray:
    """Convert layers to a straight-alpha image.

    Args:
        transmittance: T [H, W, 1] or [H, W, 3] in [0, 1].
        addition: B [H, W, 3].

    Returns:
        RGBA, uint8 [H, W, 4].
    """
    rgba = torch.cat(straight_color(transmittance, addition), dim=-1)
    return (rgba * 255.0).round().byte().cpu().numpy()
