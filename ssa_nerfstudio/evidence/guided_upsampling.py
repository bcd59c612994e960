"""Upsampling of layers from the working to the full resolution, along the edges of an image that has both.

Source: He and Sun 2015, "Fast Guided Filter".
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL, UNKNOWN_DEVIATION

RADIUS = 2
"""Working pixels: the layers are a linear function of the guide within windows of this radius."""


def reduced(image: Tensor, reduction: int) -> Tensor:
    """Box-filter an image [H, W, C] to [H // reduction, W // reduction, C]; incomplete squares are dropped."""
    return nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], reduction)[0].permute(1, 2, 0)


def reduced_deviation(deviation: Tensor, reduction: int) -> Tensor:
    """Box-filter the photos' deviation [H, W, 1] over the pixels that enough photos show (`ImageStatistics.deviation`).

    Returns:
        [H // reduction, W // reduction, 1]; NaN where no pixel is known, as behind a mask of all photos.
    """
    known = deviation != UNKNOWN_DEVIATION
    total = reduced(torch.cat([torch.where(known, deviation, 0.0), known.to(deviation)], dim=-1), reduction)
    return total[..., :1] / total[..., 1:]  # 0 / 0 is NaN


def upsample(layers: Tensor, guide: Tensor, reduction: int) -> Tensor:
    """Upsample layers along the edges of a guide.

    Args:
        layers: [H // reduction, W // reduction, C].
        guide: [H, W, G].
        reduction: factor between the two.

    Returns:
        [H, W, C].
    """
    if reduction == 1:
        return layers
    low = reduced(guide, reduction)
    mean, target = local_mean(low, RADIUS), local_mean(layers, RADIUS)
    covariance = local_mean(low[..., :, None] * low[..., None, :], RADIUS) - mean[..., :, None] * mean[..., None, :]
    joint = local_mean(low[..., :, None] * layers[..., None, :], RADIUS) - mean[..., :, None] * target[..., None, :]
    # Differences of a gray level say nothing about the layers.
    slope = torch.linalg.solve(covariance + GRAY_LEVEL**2 * torch.eye(guide.shape[2]).to(guide), joint)
    offset = target - (mean[..., None, :] @ slope)[..., 0, :]
    size = guide.shape[0], guide.shape[1], reduction
    slope, offset = enlarged(local_mean(slope, RADIUS), *size), enlarged(local_mean(offset, RADIUS), *size)
    return (guide[..., None, :] @ slope)[..., 0, :] + offset


def local_mean(values: Tensor, radius: int) -> Tensor:
    """Means [h, w, ...] over square windows of a radius in pixels, cut off at the frame."""
    means = window_mean(values.flatten(2).permute(2, 0, 1), 2 * radius + 1)
    return means.permute(1, 2, 0).reshape(values.shape)


def window_mean(images: Tensor, side: int) -> Tensor:
    """Means of images [n, h, w] over square windows of this odd side in pixels, cut off at the frame."""
    for sides in ((side, 1), (1, side)):
        margins = sides[0] // 2, sides[1] // 2
        images = nn.functional.avg_pool2d(images, sides, stride=1, padding=margins, count_include_pad=False)
    return images


def enlarged(values: Tensor, height: int, width: int, reduction: int) -> Tensor:
    """Enlarge [H // reduction, W // reduction, ...] linearly to [height, width, ...]; the last pixels are repeated."""
    planes = values.flatten(2).permute(2, 0, 1)[None]
    planes = nn.functional.interpolate(planes, scale_factor=reduction, mode="bilinear")
    missing = (0, width - planes.shape[3], 0, height - planes.shape[2])
    planes = nn.functional.pad(planes, missing, mode="replicate")
    return planes[0].permute(1, 2, 0).reshape(height, width, *values.shape[2:])
