"""Initialization of an overlay: by the paper's rule from the photos alone, or from the scene's points.

Source: the paper, section "Modeling screen-space artifacts" (W = mean, A = exp(-sigma / 0.05)); the estimate from
points is ours (docs/method.md).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.changing_area import changing_area, moving_parts
from ssa_nerfstudio.evidence.expected_layers import DETAIL_RADIUS
from ssa_nerfstudio.evidence.falloff import estimate_falloff
from ssa_nerfstudio.evidence.guided_upsampling import enlarged, local_mean, reduced, reduced_deviation, upsample
from ssa_nerfstudio.evidence.layer_estimate import LayerEstimate, estimate_layers
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed, working_reduction
from ssa_nerfstudio.evidence.present_area import present_area
from ssa_nerfstudio.evidence.static_area import connected_parts
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL, ImageStatistics
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


def estimate(
    samples: PointSamples,
    guide: Tensor,
    opaque: Tensor,
    static: Tensor,
    falloff: Tensor | None = None,
    always_hiding: Tensor | None = None,
) -> LayerEstimate:
    """Estimate an artifact's layers from samples of the scene's points.

    Args:
        samples: see `point_samples.sample_points`.
        guide: see `guide_of`, of the photos that were sampled.
        opaque: [H, W] bool: where static edges enclose something opaque (`Detection.opaque`), which holds where no
            point says otherwise.
        static: [H, W] bool: where static edges are (`Detection.mask`): clear and opaque are equally likely there.
        falloff: [h, w, 1], if it is known; None: it is estimated from the samples.
        always_hiding: bool [h, w, 1], likewise: what is known to hide the scene in all photos; None: nothing.
    """
    reduction = working_reduction(*guide.shape[:2])
    # Photos that vary nowhere show no scene.
    hidden = opaque.to(guide.device) | (guide[..., 3] < GRAY_LEVEL / 2).all()
    areas = torch.stack([hidden, static.to(guide.device)], dim=-1).to(guide)
    mean, deviation = reduced(guide[..., :3], reduction), reduced_deviation(guide[..., 3:], reduction)
    photos = torch.cat([mean, deviation, reduced(areas, reduction)], dim=-1).to(samples.color.device)
    falloff = estimate_falloff(samples, photos[..., 4:5] > 0) if falloff is None else falloff
    if (falloff < 1).any():
        photos[..., :4] /= falloff
        samples = replace(samples, color=samples.color / falloff.reshape(-1, 1)[samples.pixel]).ordered()
    if always_hiding is not None:
        photos[..., 4:5].clamp_min_(always_hiding.to(photos))
    mean, deviation, hiding, edges = photos.split((3, 1, 1, 1), dim=-1)
    found = estimate_layers(samples, mean, deviation, hiding, edges, always_hiding)
    return replace(found, falloff=falloff)


@torch.no_grad()
def initialize_from(
    overlay: ScreenSpaceOverlay, estimate: LayerEstimate, guide: Tensor, static: Tensor | None = None
) -> None:
    """Initialize an overlay from estimated layers.

    Pixels whose estimated opacity is noise (`present_area`) start clear, and where an artifact adds light, it hides
    the scene only where it hides most of it. The sparsity loss weighs a pixel by its transmittance.

    Args:
        overlay: changed in place.
        estimate: at the working resolution of the overlay's frame.
        guide: see `guide_of`.
        static: [H, W] bool: where static edges are (`Detection.mask`), something is in front of the scene, even if
            the points are too few to say what; see `_likely_colors`. None: nowhere.
    """
    transmittance, addition = estimate.transmittance, estimate.addition
    if overlay.adds_light:
        # And a pixel around, for the soft rim.
        hides = nn.functional.max_pool2d(estimate.hides().to(transmittance).permute(2, 0, 1), 3, 1, 1).permute(1, 2, 0)
        transmittance = torch.where(hides > 0, transmittance, 1.0)
    reduction = working_reduction(overlay.height, overlay.width)
    present = present_area(smallest_matte(transmittance, addition), static).to(transmittance)
    falloff = enlarged(estimate.falloff, overlay.height, overlay.width, reduction)
    layers = upsample(torch.cat([transmittance, addition], dim=-1), guide.to(addition) / falloff, reduction).clamp(0, 1)
    present = enlarged(present, overlay.height, overlay.width, reduction) > 0
    layers = torch.where(present, layers, layers.new_tensor([1.0, 0.0, 0.0, 0.0]))
    likely = None if static is None else _likely_colors(layers, static, guide[..., :3].to(layers) / falloff, reduction)
    initialize_as(overlay, layers, likely)
    overlay.noise.copy_(estimate.noise)
    if (falloff < 1).any():
        overlay.falloff = _at_overlay_resolution(falloff, overlay).to(overlay.falloff)


@torch.no_grad()
def ignore_changing(overlay: ScreenSpaceOverlay, estimate: LayerEstimate, moving: PointSamples | None = None) -> None:
    """Let the scene learn nothing where the artifact changes from photo to photo; the overlay is changed in place.

    Args:
        overlay: initialized from the estimate.
        estimate: of its layers.
        moving: the samples that it is of, where the artifact may move as a whole (`mean_light.Refined`); else None.
    """
    area = changing_area(estimate)
    if moving is not None:
        area |= moving_parts(estimate, moving)
    if area.any():
        reduction = working_reduction(overlay.height, overlay.width)
        kept = torch.from_numpy(~area)[..., None].to(overlay.reliable)
        overlay.reliable = _at_overlay_resolution(enlarged(kept, overlay.height, overlay.width, reduction), overlay)


@torch.no_grad()
def initialize_as(overlay: ScreenSpaceOverlay, layers: Tensor, likely: Tensor | None = None) -> None:
    """Initialize an overlay with layers T and B [H, W, 4] in its frame; it is changed in place.

    Args:
        overlay: changed in place.
        layers: T and B.
        likely: the artifact's color where the layers have missed it, [H, W, 3] in [0, 1]; None: its mean color.
    """
    transmittance, addition = _at_overlay_resolution(layers, overlay).split((1, 3), dim=-1)
    if overlay.adds_light:
        overlay.initialize(addition, 1 - transmittance, transmittance)
        return
    likely = _mean_color(layers) if likely is None else _at_overlay_resolution(likely, overlay)
    alpha = smallest_matte(transmittance, addition)
    floor = INITIAL_MATTE_RANGE[0]
    overlay.initialize((addition + floor * likely) / (alpha + floor), alpha, transmittance)


def guide_of(statistics: ImageStatistics) -> Tensor:
    """Mean and deviation of the photos [H, W, 4], float32: where they have edges, an artifact may have some."""
    return torch.cat([statistics.mean(), statistics.deviation()], dim=-1).float()


def _mean_color(layers: Tensor) -> Tensor:
    """Mean color [3] of the artifact with layers T and B [H, W, 4]."""
    transmittance, addition = layers.split((1, 3), dim=-1)
    total = smallest_matte(transmittance, addition).sum()
    return torch.where(total > 0, addition.sum(dim=(0, 1)) / total.clamp_min(1e-6), CONSTANT_INITIALIZATION[0])


def _likely_colors(layers: Tensor, static: Tensor, mean: Tensor, reduction: int) -> Tensor:
    """Color [H, W, 3] of the artifact where the layers have missed it.

    It is the artifact's mean color: in the photos' mean color a matte would grow wherever a render is wrong, because
    less contrast is a smaller error. But a connected part of what detection has found may be of another color, as
    white text is beside a thumb: the color of what was found in it; if nothing was, and it is brighter than what is
    around it where the mean color is darker, or the reverse, the photos' mean.

    Args:
        layers: T and B, [H, W, 4].
        static: what detection has found, [H, W] bool.
        mean: of the photos, [H, W, 3].
        reduction: photo pixels a working pixel.
    """
    overall = _mean_color(layers)
    if not static.any():
        return overall.expand_as(mean)
    static = static.to(mean.device)
    outside = 1 - static[..., None].to(mean)
    sums = local_mean(torch.cat([mean * outside, outside], dim=-1), DETAIL_RADIUS * reduction)
    around, seen = sums.split((3, 1), dim=-1)
    around = torch.where(seen > 1e-6, around / seen.clamp_min(1e-6), mean)
    agreement = ((mean - around) * (overall - around)).sum(dim=-1, keepdim=True)
    transmittance, addition = layers.split((1, 3), dim=-1)
    values = torch.cat([smallest_matte(transmittance, addition), addition, agreement], dim=-1).reshape(-1, 5)
    labels = connected_parts(static)
    parts = summed(labels.flatten(), values, int(labels.max()) + 1)
    matte, color, agreement = parts[labels].split((1, 3, 1), dim=-1)
    missed = torch.where(agreement < 0, mean, overall.expand_as(mean))
    own = torch.where(matte > 0, color / matte.clamp_min(1e-6), missed)
    return torch.where(static[..., None], own, overall)


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
