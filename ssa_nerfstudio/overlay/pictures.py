"""An artifact as a picture to look at."""

from __future__ import annotations

import torch
from torch import Tensor

_SQUARES = (0.5, 0.35)


def over_checkerboard(color: Tensor, alpha: Tensor, side: int = 8) -> Tensor:
    """A straight-alpha picture over grey squares, on which transparency shows.

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
