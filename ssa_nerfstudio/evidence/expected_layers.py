"""The layers that the prior of the estimate expects: clear, or opaque where photos and samples say so."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.guided_upsampling import local_mean
from ssa_nerfstudio.evidence.nearest_depths import OCCLUSION_RADIUS
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed
from ssa_nerfstudio.evidence.static_area import MAX_OPAQUE_DEVIATION, MIN_AREA, connected_parts, low_deviation
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL

DETAIL_RADIUS = 2 * OCCLUSION_RADIUS
"""Working pixels: the samples of a window of this radius are compared together."""


def expected_layers(
    samples: PointSamples, colors: Tensor, mean: Tensor, deviation: Tensor, hidden: Tensor, static: Tensor
) -> Tensor:
    """T and B [h, w, 4] where no sample says otherwise: clear, unless a static part or a calm area hides the scene.

    Args:
        samples: of the scene's points.
        colors: of the points, [S, 3], sample by sample.
        mean: of the photos, [h, w, 3] in [0, 1] at the working resolution.
        deviation: of the photos, [h, w, 1], likewise; NaN where it is unknown.
        hidden: share of a working pixel that is known to be opaque, [h, w, 1] in [0, 1].
        static: share of a working pixel where static edges are, likewise.
    """
    clear, constant = samples.color - colors, samples.color - mean.reshape(-1, 3)[samples.pixel]
    opaque = nn.functional.pad(mean, (1, 0))
    found = _of_static_parts(samples, colors, constant, mean, static)
    found = hidden * opaque + (1 - hidden) * found
    return torch.where(_hardly_varying(samples, clear, constant, deviation), opaque, found)


def _of_static_parts(samples: PointSamples, colors: Tensor, constant: Tensor, mean: Tensor, static: Tensor) -> Tensor:
    """T and B [h, w, 4] of the connected parts of the static area that hide the scene, and (1, 0, 0, 0) elsewhere.

    An artifact is known to be there, so clear is no likelier than opaque. A part's T is the slope of I - mean I over
    C - mean C: one for the part, because few points may be seen behind it, as behind a bonnet. Errors of C lessen a
    slope, where nothing is in front, too, so it counts relative to that of the samples outside of all parts. A part
    hides the scene if less than half comes through: then clear is a worse guess than what its samples say.
    """
    height, width = samples.size
    # Closed: a textured artifact has pixels without an edge.
    wider = nn.functional.max_pool2d((static[None, ..., 0] > 0.5).float(), 3, 1, 1)
    part = connected_parts(-nn.functional.max_pool2d(-wider, 3, 1, 1)[0]).flatten()
    count = int(part.max()) + 1
    of_sample = part[samples.pixel]
    seen = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=-1)
    around = local_mean(summed(samples.pixel, seen, height * width).reshape(height, width, 4), DETAIL_RADIUS)
    # Where no point is seen in the window, the mean over the part.
    around = torch.where(around[..., 3:] > 1e-9, around, summed(of_sample, seen, count)[part].reshape(around.shape))
    behind = around[..., :3] / around[..., 3:].clamp_min(1e-9)
    change = colors - behind.reshape(-1, 3)[samples.pixel]
    products = torch.stack([constant * change, change.square()], dim=1).sum(dim=-1)
    product, square = summed(of_sample, products, count).split(1, dim=-1)
    # Without samples nothing is known, as if all came through.
    slope = torch.where(square > 1e-9, product / square.clamp_min(1e-9), 1.0)
    slope = (slope / slope[0].clamp(1e-9, 1)).clamp(0, 1)  # label 0 is outside of all parts
    hiding = slope < 0.5
    hiding[0] = False
    transmittance = torch.where(hiding, slope, 1.0)[part].reshape(height, width, 1)
    addition = torch.where(transmittance < 1, mean - transmittance * behind, 0.0).clamp(0, 1)
    return torch.cat([transmittance, addition], dim=-1)


def _hardly_varying(samples: PointSamples, clear: Tensor, constant: Tensor, deviation: Tensor) -> Tensor:
    """Calm areas whose samples show nothing of the scene: bool [h, w, 1].

    An area is calm because the photos vary there at most MAX_OPAQUE_DEVIATION times as much as elsewhere. An artifact
    is the reason only if they also vary so little beside what is behind: |I - mean| is T |C - mean C|, so its ratio to
    |I - C| is about T where T is small, and 1 where what is behind is plain. A pixel's ratio is that of its window,
    and an area's the mean over its pixels: otherwise many points behind a button would speak for a path beside it.
    """
    height, width = samples.size
    low = torch.from_numpy(low_deviation(deviation[..., 0].cpu().numpy())).to(deviation.device)
    area = connected_parts(low, connectivity=4).flatten()
    size = torch.bincount(area)
    area = torch.where(size[area] < MIN_AREA, 0, area)
    # A gray level, because photos are rounded.
    values = torch.stack([constant, clear], dim=1).abs().mean(dim=-1) + GRAY_LEVEL
    values = values * (area[samples.pixel] > 0)[:, None]
    around = local_mean(summed(samples.pixel, values, height * width).reshape(height, width, 2), DETAIL_RADIUS)
    varying, missing = around.reshape(-1, 2).split(1, dim=-1)
    known = (missing > 1e-9).to(missing)
    ratio = (varying / missing.clamp_min(1e-12)).clamp_max(1)
    total, count = summed(area, torch.cat([known * ratio, known], dim=-1), len(size)).split(1, dim=-1)
    hiding = (count > 0) & (total <= MAX_OPAQUE_DEVIATION * count)
    hiding[0] = False
    return hiding[area].reshape(height, width, 1)
