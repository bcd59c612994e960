"""How far views see: the nearest of the points around each pixel."""

from __future__ import annotations

import torch
from torch import Tensor, nn

OCCLUSION_RADIUS = 2
"""Working pixels."""


def nearest_depths(view: Tensor, pixel: Tensor, depth: Tensor, size: tuple[int, int, int]) -> Tensor:
    """Least depth within OCCLUSION_RADIUS of each working pixel, [V, h w]; infinite where there is none.

    Args:
        view, pixel, depth: of M points in views, [M] each.
        size: number of views, height and width of the working frame.
    """
    views, height, width = size
    nearest = torch.full((views * height * width,), torch.inf, device=depth.device, dtype=depth.dtype)
    nearest = nearest.scatter_reduce(0, view * (height * width) + pixel, depth, "amin").reshape(-1, height, width)
    side = 2 * OCCLUSION_RADIUS + 1
    return -nn.functional.max_pool2d(-nearest, side, stride=1, padding=OCCLUSION_RADIUS).flatten(1)
