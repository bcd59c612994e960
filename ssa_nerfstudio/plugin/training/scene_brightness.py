"""The scene's brightness: that of the photos where the artifact hides least.

Photos fix T C + B, not T and C: the scene may be brighter behind a thin film over the whole frame. What the
initialization settles (the clearest fifth of the frame is clear), a training can undo, because a falloff is known only
roughly and not learned. docs/method.md derives it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from nerfstudio.models.splatfacto import RGB2SH, SH2RGB
from torch import Tensor

from ssa_nerfstudio.evidence.layer_estimate import CLEAR_SHARE
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay

MIN_TRANSMITTANCE = 0.5
"""An overlay that hides more than half of the scene everywhere is no film: the photos show no clear pixel."""


@torch.no_grad()
def clear_the_clearest(overlays: Sequence[ScreenSpaceOverlay], constant: Tensor, rest: Tensor) -> None:
    """Move the film that all overlays have in common from them to the scene; their composites stay as they are.

    Args:
        overlays: of all photos; changed in place.
        constant, rest: the colors of N Gaussians, changed in place, too: coefficients of harmonics [N, 3] and
            [N, K, 3], or logits [N, 3] where K is 0.
    """
    films = [overlay.clearest(CLEAR_SHARE) for overlay in overlays]
    transmittance, addition = max(films, key=lambda film: float(film[0]))
    if transmittance < MIN_TRANSMITTANCE:
        return
    for overlay in overlays:
        overlay.clear(transmittance, addition)
    show_through(transmittance, addition, constant, rest)


@torch.no_grad()
def show_through(transmittance: Tensor, addition: Tensor, constant: Tensor, rest: Tensor) -> None:
    """Give Gaussians, as in `clear_the_clearest`, the colors T C + B that they have behind a film, T [] and B [3]."""
    if rest.shape[1]:
        constant.copy_(RGB2SH(transmittance * SH2RGB(constant) + addition))
        rest.mul_(transmittance)
    else:
        constant.copy_(torch.logit(transmittance * torch.sigmoid(constant) + addition, eps=1e-6))
