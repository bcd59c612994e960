"""An artifact as a picture to look at."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio.overlay.resampling import straight_color

_SQUARES = (0.5, 0.35)


def over_checkerboard(color: Tensor, alpha: Tensor, side: int = 8) -> Tensor:
    """A straight-alpha picture over gray squares, on which transparency shows.

    Args:
        color: [H, W, 3] in [0, 1].
        alpha: [H, W, 1] in [0, 1].
        side: of a square, pixels.

    Returns:
        [H, W, 3].
    """
    rows = torch.arange(color.shape[0], device=color.device)[:, None] // side
    columns = torch.arange(color.shape[1], device=color.device) // side
    light, dark = _SQUARES
    board = dark + (light - dark) * ((rows + columns) % 2 == 0)[..., None].to(color.dtype)
    return alpha * color + (1.0 - alpha) * board


def straight_bytes(transmittance: Tensor, addition: Tensor) -> np.ndarray:
    """Layers [H, W, 1 or 3] and [H, W, 3] as a straight-alpha picture: RGBA, uint8 [H, W, 4]."""
    rgba = torch.cat(straight_color(transmittance, addition), dim=-1)
    return (rgba.clamp(0.0, 1.0) * 255.0).round().byte().cpu().numpy()
