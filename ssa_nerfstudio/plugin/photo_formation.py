"""From the clean render to the photo of a training view: exposure and overlay, in the order in which they came about.

The camera exposes what is in front of it, an artifact on its lens included; software draws into the finished photo.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ssa_nerfstudio.overlay.compositing import clip_straight_through
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.exposure import Exposure


def clean_image(color: Tensor, accumulation: Tensor, background: Tensor, white: float) -> Tensor:
    """The clean render [H, W, 3]: splats over a background, clipped to [0, white].

    Args:
        color: of the splats alone, premultiplied [H, W, 3].
        accumulation: their opacity [H, W, 1].
        background: [3].
        white: 1, or more where a photo's exposure may bring it back below 1.
    """
    # hardtanh, because its gradient is one kernel and clamp's are five.
    return F.hardtanh(torch.addcmul(color, 1.0 - accumulation, background), 0.0, white)


def predicted_photo(
    drawn: Mapping[str, Any],
    artifacts: Artifacts,
    exposure: Exposure | None,
    view: int | None,
    reduction: int,
    ignore_background: bool,
    light: Tensor | None = None,
) -> Tensor | None:
    """Predict a training photo, [H // reduction, W // reduction, 3].

    With T and B of the overlay, B times the photo's light, and E of the exposure: E(T C + B), or
    T E(C) + B where exposure acts on the scene.

    Args:
        drawn: the model's outputs: rgb C, accumulation and background.
        artifacts: the model's overlays.
        exposure: of the photos; None where it is not modeled.
        view: the training view; None: the camera is none.
        reduction: factor by which training images are reduced.
        ignore_background: see `behind` of `ScreenSpaceOverlay.composite`.
        light: factor of B in this photo, [H // reduction, W // reduction, 3]; None: 1.

    Returns:
        None where the photo is the clean render.
    """
    if view is None or (exposure is None and not len(artifacts)):
        return None
    overlay = artifacts.of_view(view) if len(artifacts) else None
    exposed = None if exposure is None else exposure.of_view(view)
    clean, background = drawn["rgb"], drawn["background"]
    if overlay is None:
        return None if exposed is None else exposed.expose(clean)
    if exposed is not None and exposure is not None and exposure.place == "scene":
        # Where nothing is drawn, the exposed render shows the exposed background.
        clean, background, exposed = exposed.expose(clean), exposed.expose(background), None
    behind = (drawn["accumulation"], background) if ignore_background else None
    if light is not None and isinstance(overlay, ScreenSpaceOverlay):
        photo = overlay.composite(clean, reduction, behind, light)
    else:
        photo = overlay.composite(clean, reduction, behind)
    if exposed is not None:
        return exposed.expose(photo)
    return clip_straight_through(photo) if artifacts.exceed_white or light is not None else photo
