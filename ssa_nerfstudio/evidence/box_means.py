"""Means of photos over squares: in boxes of one size, read between pixels, and in patches of any size."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def box_means(images: Tensor, side: int) -> Tensor:
    """Means [..., H - side + 1, W - side + 1, C] of images [..., H, W, C] over all squares of this side."""
    means = images.float()
    for dim in (-3, -2):
        length = means.shape[dim] - side + 1
        rows = means.narrow(dim, 0, length).clone()
        for shift in range(1, side):
            rows += means.narrow(dim, shift, length)
        means = rows / side
    return means


def read_boxes(boxes: Tensor, view: Tensor, position: Tensor, side: int) -> Tensor:
    """Means [M, C] over the boxes around x, y [M, 2], moved into the frame; between pixels by bilinear interpolation.

    Args:
        boxes: of V views, see `box_means`.
        view: [M], whose.
        position: in the photo, pixels.
        side: of the boxes.
    """
    height, width = boxes.shape[1:3]
    corner = torch.minimum((position - side / 2).clamp_min(0), position.new_tensor([width - 1, height - 1]))
    (left, top), (x, y) = corner.long().unbind(dim=-1), corner.frac().to(boxes)[..., None].unbind(dim=1)
    right, bottom = (left + 1).clamp_max(width - 1), (top + 1).clamp_max(height - 1)
    upper, lower = (boxes[view, row, left].lerp(boxes[view, row, right], x) for row in (top, bottom))
    return upper.lerp(lower, y)


def patch_means(images: Tensor, view: Tensor, pixel: Tensor, side: Tensor) -> Tensor:
    """Means [M, C] of images [V, h, w, C] of views [M] over squares of sides [M] around pixels [M], in the frame."""
    height, width = images.shape[1:3]
    sums = nn.functional.pad(images.double().cumsum(1).cumsum(2), (0, 0, 1, 0, 1, 0))
    place = torch.stack([pixel % width, pixel // width], dim=-1)
    side = side[:, None].round().clamp_max(2 * max(height, width))
    first = (place + 0.5 - side / 2).round().long()
    last = (first + side.long()).minimum(place.new_tensor([width, height]))
    (left, top), (right, bottom) = first.clamp_min(0).unbind(dim=-1), last.unbind(dim=-1)
    total = sums[view, bottom, right] - sums[view, top, right] - sums[view, bottom, left] + sums[view, top, left]
    return (total / ((right - left) * (bottom - top))[:, None]).float()
