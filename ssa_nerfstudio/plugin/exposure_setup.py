"""The photos' exposure before training: their gains, and whether the artifact has it, too."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.photo_exposure import artifact_follows, relative_gains, sample_each
from ssa_nerfstudio.evidence.point_samples import PointSamples, working_reduction
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.artifacts import Artifacts, Overlay
from ssa_nerfstudio.plugin.decisions import tell
from ssa_nerfstudio.plugin.exposure import Exposure, Place
from ssa_nerfstudio.plugin.overlay_setup import views_of

_MEANING: dict[Place, str] = {
    "photo": "acts on scene and artifact, which is on or in front of the lens",
    "scene": "acts on the scene alone, and software drew the artifact",
}


def start_from_points(
    exposure: Exposure, photos: list[dict[str, Any]], cameras: Cameras, points: Tensor | None
) -> list[PointSamples] | None:
    """Start the exposures from the gains that the scene's points show.

    Args:
        exposure: changed in place.
        photos: the datamanager's undistorted cache.
        cameras: of the photos.
        points: of the scene [N, 3]; None where there are none, and the exposures start from the identity.

    Returns:
        The samples of each photo, for `start_beside_artifact`; None where there are no points.
    """
    if points is None or not len(points):
        return None
    samples = sample_each(points.to(photos[0]["image"].device), views_of(photos, cameras))
    with torch.no_grad():
        exposure.transforms[:, 0] = relative_gains(samples)
    return samples


def start_beside_artifact(
    exposure: Exposure, artifacts: Artifacts, samples: list[PointSamples], choose_place: bool
) -> None:
    """Start the exposures once more, from samples that no artifact hides, and choose what exposure acts on.

    Args:
        exposure: changed in place.
        artifacts: the initial overlays.
        samples: from `start_from_points`.
        choose_place: choose it from the photos where they show the artifact, and print what was chosen.
    """
    # Photos, and with them samples, may be cached elsewhere than on the training's device.
    device = samples[0].color.device
    overlays = [artifacts[number] for number in range(len(artifacts))]
    found = {overlay: _working_layers(overlay).to(device).split((4, 1), dim=-1) for overlay in overlays}
    shown = [artifacts.of_view(view) for view in range(len(samples))]
    layers = [None if overlay is None else found[overlay][0] for overlay in shown]
    # A falloff hides nothing: samples are divided by it.
    samples = [
        each if overlay is None else replace(each, color=each.color / found[overlay][1].reshape(-1, 1)[each.pixel])
        for each, overlay in zip(samples, shown, strict=True)
    ]
    log_gains = relative_gains(samples, layers)
    with torch.no_grad():
        exposure.transforms[:, 0] = log_gains
    if not choose_place:
        return
    follows = artifact_follows(samples, layers, log_gains)
    if follows is not None:
        exposure.place = "photo" if follows else "scene"
    why = "no point is seen behind the artifact" if follows is None else "as the photos show"
    tell(f"Exposure {_MEANING[exposure.place]} ({why}). (--pipeline.model.exposure-place states it.)")


@torch.no_grad()
def _working_layers(overlay: Overlay) -> Tensor:
    """T and B before the falloff, and the falloff, [h, w, 5], at the working size of point samples."""
    if isinstance(overlay, ScreenSpaceOverlay):
        (transmittance, addition), falloff = overlay.before_falloff(), overlay.falloff_at()
    else:
        transmittance, addition = overlay.layers()
        falloff = torch.ones_like(addition[..., :1])
    everything = torch.cat([transmittance.mean(dim=-1, keepdim=True), addition, falloff], dim=-1)
    return reduced(everything, working_reduction(overlay.height, overlay.width))
