"""Resampling of premultiplied layers [H, W, C], pixel-aligned with the way training images are reduced.

Straight colors must not be averaged: a transparent pixel's color means nothing and would bleed into its neighbors.
The pair (transmittance, addition) is averaged instead, in which compositing is linear.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def box_reduce(layer: Tensor, factor: int) -> Tensor:
    """Average blocks of factor x factor pixels, the filter by which `splatfacto.resize_image` reduces the photos.

    Args:
        layer: [H, W, C].
        factor: side of a block, pixels.

    Returns:
        [H // factor, W // factor, C]; rows and columns that fill no block are dropped.
    """
    if factor == 1:
        return layer
    height, width = layer.shape[0] // factor, layer.shape[1] // factor
    blocks = layer[: height * factor, : width * factor].reshape(height, factor, width, factor, layer.shape[2])
    return blocks.mean(dim=(1, 3))


def enlarge(layer: Tensor, factor: int, height: int, width: int) -> Tensor:
    """Upsample [h, w, C] bilinearly by an integer factor and crop to [height, width, C] at the upper left corner."""
    if factor > 1:
        planes = F.interpolate(layer.permute(2, 0, 1)[None], scale_factor=float(factor), mode="bilinear")
        layer = planes[0].permute(1, 2, 0)
    return layer[:height, :width]


def letterbox(layer: Tensor, height: int, width: int, fill: float) -> Tensor:
    """Fit a layer into a frame of any size and aspect: scaled without stretching, centered.

    Args:
        layer: [H, W, C].
        height, width: of the frame, pixels.
        fill: value of the bars: 1 for a transmittance, 0 for an addition.

    Returns:
        [height, width, C].
    """
    if layer.shape[:2] == (height, width):
        return layer
    scale = min(height / layer.shape[0], width / layer.shape[1])
    inner = max(1, min(height, round(layer.shape[0] * scale))), max(1, min(width, round(layer.shape[1] * scale)))
    planes = F.interpolate(layer.permute(2, 0, 1)[None], size=inner, mode="bilinear", antialias=scale < 1)
    framed = layer.new_full((height, width, layer.shape[2]), fill)
    top, left = (height - inner[0]) // 2, (width - inner[1]) // 2
    framed[top : top + inner[0], left : left + inner[1]] = planes[0].permute(1, 2, 0)
    return framed


def reduced_size(height: int, width: int, factor: int) -> tuple[int, int]:
    """Size of an overlay with one pixel for each block, whole or partial, of factor x factor pixels of its frame."""
    return -(-height // factor), -(-width // factor)


def to_training_scale(layer: Tensor, resolution: int, reduction: int, height: int, width: int) -> Tensor:
    """Resample an overlay at 1 / `resolution` of the frame to a training image at 1 / `reduction` of the frame.

    Args:
        layer: [ceil(H / resolution), ceil(W / resolution), C] of a frame [H, W].
        resolution, reduction: powers of two.
        height, width: the frame.

    Returns:
        [H // reduction, W // reduction, C].
    """
    target = height // reduction, width // reduction
    if reduction >= resolution:
        return box_reduce(layer, reduction // resolution)[: target[0], : target[1]]
    return enlarge(layer, resolution // reduction, *target)


def premultiply(color: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Convert straight color [..., 3] and matte [..., 1] to transmittance [..., 1] and addition [..., 3]."""
    return 1.0 - alpha, alpha * color


def smallest_matte(transmittance: Tensor, addition: Tensor) -> Tensor:
    """The smallest matte [..., 1] in [0, 1] that carries layers: one minus the mean T, and at least B."""
    hidden = 1.0 - transmittance.mean(dim=-1, keepdim=True)
    return torch.maximum(hidden, addition.amax(dim=-1, keepdim=True)).clamp_max(1.0)


def straight_color(transmittance: Tensor, addition: Tensor) -> tuple[Tensor, Tensor]:
    """Convert layers to straight color and matte, the inverse of `premultiply`.

    Additive light has no straight color: it gets the smallest matte that can carry it.

    Args:
        transmittance: T [..., 1] or [..., 3] in [0, 1]; the matte is one minus its mean.
        addition: B [..., 3], not negative.

    Returns:
        Color [..., 3] in [0, 1], black where the matte is zero, and matte [..., 1] in [0, 1].
    """
    alpha = smallest_matte(transmittance, addition)
    return (addition / alpha.clamp_min(1e-6)).clamp(0.0, 1.0), alpha
