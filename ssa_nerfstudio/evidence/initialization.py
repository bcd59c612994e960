"""Initialization of an overlay: by the paper's rule from the photos alone, or from the scene's points.

Source: the paper, section "Modeling screen-space artifacts" (W = mean, A = exp(-sigma / 0.05)); the estimate from
points is ours (docs/method.md).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.changing_area import changing_area
from ssa_nerfstudio.evidence.falloff import estimate_falloff
from ssa_nerfstudio.evidence.guided_upsampling import enlarged, reduced, upsample
from ssa_nerfstudio.evidence.layer_estimate import MIN_OPACITY, LayerEstimate, estimate_layers
from ssa_nerfstudio.evidence.point_samples import PointSamples, working_reduction
from ssa_nerfstudio.evidence.static_area import HALF_GRAY_LEVEL
from ssa_nerfstudio.evidence.statistics import ImageStatistics
from ssa_nerfstudio.overlay.layer import CONSTANT_INITIALIZATION, INITIAL_MATTE_RANGE, ScreenSpaceOverlay
from ssa_nerfstudio.overlay.resampling import smallest_matte

STATISTICS_SCALE = 0.05
"""s of the paper: a standard deviation of s over the views gives an initial matte of 1 / e."""


@torch.no_grad()
def initialize(overlay: ScreenSpaceOverlay, statistics: ImageStatistics, within: Tensor | None = None) -> None:
    """Initialize an overlay by the paper's rule: the mean color, and a matte that falls with the deviation.

    Args:
        overlay: changed in place.
        statistics: of the photos, in the overlay's frame.
        within: [H, W] bool, outside of which the overlay starts clear; None: the rule holds everywhere.

    Raises:
        ValueError: the statistics have another frame size than the overlay.
    """
    if statistics.size != (overlay.height, overlay.width):
        raise ValueError(f"statistics of a frame {statistics.size} for an overlay of {(overlay.height, overlay.width)}")
    alpha, mean = _papers_matte(statistics, within), statistics.mean()
    # Averaged premultiplied; the floor keeps the mean color where the matte is 0.
    weight = alpha.clamp_min(1e-9)
    layers = _at_overlay_resolution(torch.cat([weight, weight * mean], dim=-1), overlay)
    alpha, addition = layers.split((1, 3), dim=-1)
    overlay.initialize(addition / alpha, alpha, 1 - alpha)


def estimate(samples: PointSamples, guide: Tensor, opaque: Tensor) -> LayerEstimate:
    """Estimate an artifact's layers from samples of the scene's points.

    Args:
        samples: see `point_samples.sample_points`.
        guide: see `guide_of`, of the photos that were sampled.
        opaque: [H, W] bool: where static edges enclose something opaque (`Detection.opaque`), which holds where no
            point says otherwise.
    """
    reduction = working_reduction(*guide.shape[:2])
    # Photos that vary nowhere show no scene.
    hidden = (opaque.to(guide.device) | (guide[..., 3] < HALF_GRAY_LEVEL).all()).to(guide)[..., None]
    photos = torch.cat([guide, hidden * guide[..., :3], 1 - hidden], dim=-1)
    photos = reduced(photos, reduction).to(samples.color.device)
    falloff = estimate_falloff(samples)
    photos[..., :7] /= falloff
    mean, deviation, addition, transmittance = photos.split((3, 1, 3, 1), dim=-1)
    if (falloff < 1).any():  # else they are sorted already
        samples = replace(samples, color=samples.color / falloff.reshape(-1, 1)[samples.pixel]).ordered()
    found = estimate_layers(samples, mean, deviation, torch.cat([transmittance, addition], dim=-1))
    return replace(found, falloff=falloff)


@torch.no_grad()
def initialize_from(overlay: ScreenSpaceOverlay, estimate: LayerEstimate, guide: Tensor) -> None:
    """Initialize an overlay from estimated layers.

    Pixels whose estimated opacity is noise start clear. The sparsity loss weighs a pixel by its transmittance.

    Args:
        overlay: changed in place.
        estimate: at the working resolution of the overlay's frame.
        guide: see `guide_of`.
    """
    transmittance, addition = estimate.transmittance, estimate.addition
    if overlay.adds_light:
        transmittance = torch.ones_like(transmittance)
    opacity = smallest_matte(transmittance, addition)
    # A pixel wider, for the soft rim.
    present = nn.functional.max_pool2d((opacity > MIN_OPACITY).float().permute(2, 0, 1), 3, 1, 1).permute(1, 2, 0)
    reduction = working_reduction(overlay.height, overlay.width)
    falloff = enlarged(estimate.falloff, overlay.height, overlay.width, reduction)
    layers = upsample(torch.cat([transmittance, addition], dim=-1), guide.to(addition) / falloff, reduction).clamp(0, 1)
    present = enlarged(present, overlay.height, overlay.width, reduction) > 0
    initialize_as(overlay, torch.where(present, layers, layers.new_tensor([1.0, 0.0, 0.0, 0.0])))
    if (falloff < 1).any():
        overlay.falloff = _at_overlay_resolution(falloff, overlay).to(overlay.falloff)


@torch.no_grad()
def ignore_changing(overlay: ScreenSpaceOverlay, estimate: LayerEstimate) -> None:
    """Let the scene learn nothing where the artifact changes from photo to photo; the overlay is changed in place."""
    if (area := changing_area(estimate)).any():
        reduction = working_reduction(overlay.height, overlay.width)
        kept = torch.from_numpy(~area)[..., None].to(overlay.reliable)
        overlay.reliable = _at_overlay_resolution(enlarged(kept, overlay.height, overlay.width, reduction), overlay)


@torch.no_grad()
def initialize_as(overlay: ScreenSpaceOverlay, layers: Tensor) -> None:
    """Initialize an overlay with layers T and B [H, W, 4] in its frame; it is changed in place."""
    transmittance, addition = _at_overlay_resolution(layers, overlay).split((1, 3), dim=-1)
    if overlay.adds_light:
        overlay.initialize(addition, 1 - transmittance, transmittance)
        return
    # Where the artifact was missed, its mean color is the likeliest. In the photos' mean color a matte would grow
    # wherever a render is wrong: less contrast is a smaller error.
    alpha = smallest_matte(transmittance, addition)
    total = alpha.sum()
    likely = torch.where(total > 0, addition.sum(dim=(0, 1)) / total.clamp_min(1e-6), CONSTANT_INITIALIZATION[0])
    floor = INITIAL_MATTE_RANGE[0]
    overlay.initialize((addition + floor * likely) / (alpha + floor), alpha, transmittance)


def guide_of(statistics: ImageStatistics) -> Tensor:
    """Mean and deviation of the photos [H, W, 4], float32: where they have edges, an artifact may have some."""
    return torch.cat([statistics.mean(), statistics.deviation()], dim=-1).float()


def _papers_matte(statistics: ImageStatistics, within: Tensor | None) -> Tensor:
    """exp(-sigma / s) [H, W, 1], float64; 0 outside of a mask [H, W]."""
    alpha = torch.exp(-statistics.deviation() / STATISTICS_SCALE)
    return alpha if within is None else alpha * within.to(alpha.device)[..., None]


def _at_overlay_resolution(layers: Tensor, overlay: ScreenSpaceOverlay) -> Tensor:
    """Layers [H, W, C] averaged to the overlay's resolution [h, w, C]."""
    if overlay.resolution == 1:
        return layers
    height, width = (side * overlay.resolution for side in overlay.alpha_logits.shape[:2])
    planes = layers.permute(2, 0, 1)[None]
    padded = nn.functional.pad(planes, (0, width - overlay.width, 0, height - overlay.height), mode="replicate")
    return nn.functional.avg_pool2d(padded, overlay.resolution)[0].permute(1, 2, 0)
