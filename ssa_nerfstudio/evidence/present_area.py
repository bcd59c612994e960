"""Where an estimate has found an artifact, and where its opacity is noise."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.layer_estimate import CERTAIN_OPACITY, MIN_OPACITY
from ssa_nerfstudio.evidence.point_samples import summed, working_reduction
from ssa_nerfstudio.evidence.static_area import connected_parts

CERTAIN_SHARE = 0.05
"""Share of a connected area that has to be above CERTAIN_OPACITY: of a film that errors make, a few pixels are. A soft
spot, whose opacity falls like a Gaussian, has such a share from a peak of 0.32 on."""


def present_area(opacity: Tensor, static: Tensor | None = None) -> Tensor:
    """Where an estimated opacity is more than noise, and a pixel around, for the soft rim: bool [h, w, 1].

    Opacities below MIN_OPACITY are noise. A connected area of others may be, too: errors of the points' places and
    colors make a film of what is hard to see. It counts if more than CERTAIN_SHARE of it is above CERTAIN_OPACITY, or
    if it holds a static edge.

    Args:
        opacity: [h, w, 1] in [0, 1], at the working resolution.
        static: [H, W] bool, where static edges are (`Detection.mask`), of the photos' size; None: nowhere.
    """
    area = connected_parts(opacity[..., 0] > MIN_OPACITY)[..., None]
    edge = torch.zeros_like(opacity)
    if static is not None:
        edge = reduced(static.to(opacity)[..., None], working_reduction(*static.shape)) > 0
    values = torch.stack([torch.ones_like(opacity), opacity > CERTAIN_OPACITY, edge], dim=-1).reshape(-1, 3)
    pixels, certain, edges = summed(area.flatten(), values, int(area.max()) + 1).unbind(-1)
    kept = ((certain > CERTAIN_SHARE * pixels) | (edges > 0)).to(opacity)
    kept[0] = 0
    return nn.functional.max_pool2d(kept[area].permute(2, 0, 1), 3, 1, 1).permute(1, 2, 0) > 0
