"""Color correction of a render, for test photos whose exposure is not known.

nerfstudio and gsplat report a `cc_psnr`, too, and fit a quadratic polynomial of all channels to each view. Here a gain
and an offset per channel are fitted, the freedom that photos of one scene have; all else still counts as an error.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ssa_nerfstudio.metrics.image import checked_unit_range


def color_corrected(render: Tensor, target: Tensor) -> Tensor:
    """Bring a render to a photo's exposure by a gain and an offset per channel, by least squares.

    Args:
        render: image [H, W, 3], floating point, in [0, 1].
        target: the photo, of the same shape and range.

    Returns:
        The corrected render, float64, clipped to [0, 1]. A channel that is constant gets the photo's mean.

    Raises:
        ValueError: an image is not a finite floating-point [H, W, 3] in [0, 1].
    """
    render, target = checked_unit_range(render, "render", 3), checked_unit_range(target, "target", 3).to(render.device)
    mean, goal = render.mean(dim=(0, 1)), target.mean(dim=(0, 1))
    variance = (render - mean).square().mean(dim=(0, 1))
    covariance = ((render - mean) * (target - goal)).mean(dim=(0, 1))
    gain = torch.where(variance > 1e-12, covariance / variance.clamp_min(1e-12), 0.0)
    return (goal + gain * (render - mean)).clamp(0.0, 1.0)
