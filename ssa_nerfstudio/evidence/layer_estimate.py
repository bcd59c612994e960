"""Estimation of an artifact's layers from the scene's points, before any training.

A photo shows I = T C + B. A point of the scene has the same color C in every view, at another pixel in each; the
artifact has the same T and B at a pixel in every view. So colors of points, and T and B of pixels, follow from each
other by linear regression: the training's own problem, solved on the points alone. docs/method.md derives it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ssa_nerfstudio._system.in_place_graphs import repeat
from ssa_nerfstudio.evidence.edge_evidence import EVIDENCE_THRESHOLDS
from ssa_nerfstudio.evidence.expected_layers import DETAIL_RADIUS, expected_layers
from ssa_nerfstudio.evidence.first_colors import first_colors
from ssa_nerfstudio.evidence.guided_upsampling import local_mean
from ssa_nerfstudio.evidence.nearest_depths import OCCLUSION_RADIUS
from ssa_nerfstudio.evidence.point_samples import PointSamples, summed
from ssa_nerfstudio.evidence.static_area import parts_of_share
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL
from ssa_nerfstudio.overlay.resampling import smallest_matte

ROUNDS = 8
"""Alternations between layers and colors of points; the last half under the sparse prior."""
CONJUGATE_GRADIENT_STEPS = 80
PRIOR_SCALE = 0.05
"""Difference of T or B up to which the sparse prior takes a pixel for as expected."""
SMOOTHNESS_FLOOR = 0.01
"""Difference of layers between neighboring working pixels that is expected even where photos are uniform."""
MEAN_CONTRAST = 1 / 3
"""Contrast of an artifact and the scene behind it, the mean difference of two gray levels in [0, 1]: an edge of T
changes the photos' mean by so much of its own height."""
OUTLIER_SCALE = 2.385
"""Residuals beyond so many standard deviations lose their weight (Cauchy): reflections, points that are hidden. With
this scale the estimate has 95 % of least squares' efficiency under Gaussian noise."""
CLEAR_SHARE = 0.2
"""Share of the frame that is taken for clear: its transmittance is set to 1, because T C fixes only the product."""
MIN_OPACITY = 2 * PRIOR_SCALE
"""Opacities below this are noise."""
CERTAIN_OPACITY = EVIDENCE_THRESHOLDS[0] * PRIOR_SCALE
"""Opacities above this are rarely noise, as edges of so many standard errors are: at most 1.0 % of the frame of four
clean captures."""
MIN_SHARE = 0.02
"""Share of the frame above CERTAIN_OPACITY from which on there is an artifact without static edges, and of a connected
area that hides the scene. What is found on less may be an error of the layers."""
LIGHT_SHARE = 1 / 3
"""Share of an artifact's light from which on it adds light: of what even white in place of the scene would not give. It
is not all of it, because errors of T make some of it pass for light of what hides."""


@dataclass(frozen=True)
class LayerEstimate:
    """Estimated layers at the working resolution: I = F (T C + B)."""

    transmittance: Tensor
    """T [h, w, 1] in [0, 1]."""
    addition: Tensor
    """B [h, w, 3] in [0, 1]."""
    falloff: Tensor
    """F [h, w, 1] in (0, 1], of a lens or a photo editor: see `falloff.estimate_falloff`."""
    unexplained: Tensor
    """[h, w, 1] in [0, 1]: share of the samples around a pixel that are outliers to these layers; NaN without any."""
    noise: Tensor = field(default_factory=lambda: torch.ones(()))
    """Robust deviation of the samples from layers and colors before the last turn, [] in (0, 1]; 1: unknown."""
    colors: Tensor | None = None
    """Of the points, [N, 3] in [0, 1]; None: unknown."""

    def opacity(self) -> Tensor:
        """The least matte [h, w, 1] that explains T and B."""
        return smallest_matte(self.transmittance, self.addition)

    def left_of(self, samples: PointSamples, those: Tensor) -> Tensor:
        """What the layers leave of samples [S, 3], given their indices: I - F (T C + B). Colors have to be known."""
        assert self.colors is not None
        pixel, observed = samples.pixel[those], samples.color[those]
        behind = self.transmittance.reshape(-1, 1)[pixel] * self.colors[samples.point[those]]
        return observed - self.falloff.reshape(-1, 1)[pixel] * (behind + self.addition.reshape(-1, 3)[pixel])

    def share(self) -> float:
        """Share of the frame that is hidden or lit by more than CERTAIN_OPACITY."""
        opacity = smallest_matte(self.falloff * self.transmittance, self.falloff * self.addition)
        return float((opacity > CERTAIN_OPACITY).float().mean())

    def hides(self) -> Tensor:
        """Where the artifact hides more of the scene than it shows, bool [h, w, 1]: connected areas of MIN_SHARE of the
        frame, because smaller ones may be errors of the layers."""
        return parts_of_share(self.transmittance[..., 0] < 0.5, MIN_SHARE)[..., None] > 0

    def adds_light(self, area: Tensor) -> bool:
        """Whether the artifact adds light: not what hides (`hides`), as a dashboard behind rain, but the rest of it.

        What hides at most replaces the scene's light by its own, B <= 1 - T. Light that exceeds it is added; true if
        that is more than LIGHT_SHARE of the light of details, which a film of errors has not, and more than noise
        beside all that is not clear: a few drops are no reason to let mud add light. All by squares, where there is
        more than noise: a film of errors that hides little may well exceed it.

        Args:
            area: bool [h, w, 1], where the artifact is (`present_area`).
        """
        opacity, added = self.opacity(), self.addition.amax(dim=-1, keepdim=True)
        shown = area & (opacity > MIN_OPACITY) & ~self.hides()
        excess = (1 - (1 - self.transmittance) / added.clamp_min(1e-6)).clamp(0, 1)[shown]
        details = (added * (added - local_mean(added, DETAIL_RADIUS)).clamp_min(0))[shown]
        light = (excess * added[shown].square()).sum()
        mostly = (excess * details).sum() > LIGHT_SHARE * details.sum()
        return bool(mostly & (light > MIN_OPACITY**2 * opacity[shown].square().sum()))


@torch.no_grad()
def estimate_layers(
    samples: PointSamples,
    mean: Tensor,
    deviation: Tensor,
    hidden: Tensor,
    static: Tensor,
    always_hiding: Tensor | None = None,
) -> LayerEstimate:
    """Estimate T and B of every pixel.

    Minimizes, over T, B and the points' colors C, the robust squares of I - T C - B over all samples, with two priors:
    neighboring pixels differ as mean and deviation of the photos do there, by more where an artifact is, and most
    pixels are as `expected_layers` says (Cauchy, so that a pixel whose samples say otherwise is not drawn back).

    Args:
        samples: of the scene's points.
        mean: of the photos, [h, w, 3] in [0, 1] at the working resolution.
        deviation: of the photos, [h, w, 1], likewise; NaN where it is unknown.
        hidden: share of a working pixel that is known to be opaque, [h, w, 1] in [0, 1].
        static: share of a working pixel where static edges are, likewise.
        always_hiding: bool [h, w, 1]: pixels that start as opaque, whatever their samples say of the points' colors,
            because these may be behind the artifact in all photos. None: no such pixels are known.
    """
    height, width = samples.size
    observed, point, pixel = samples.color, samples.point, samples.pixel
    colors, residual = first_colors(samples, mean, deviation, always_hiding)
    across, down = _photo_differences(mean, deviation, 1), _photo_differences(mean, deviation, 0)
    layers = expected = expected_layers(samples, colors[point], mean, deviation, hidden, static)
    prior = torch.ones_like(layers[..., :1])
    seen_by = torch.bincount(point, minlength=samples.points)[point]
    uncertainty = 1 / (seen_by[:, None] - 1.0).clamp_min(1e-6)
    for round_ in range(ROUNDS):
        scale = robust_deviation(residual)
        weight = 1 / (1 + residual.square().mean(dim=-1, keepdim=True) / (OUTLIER_SCALE * scale) ** 2)
        behind = colors[point]
        precision = weight / (scale**2 * (1 + uncertainty))
        moments = torch.cat(
            [
                torch.ones_like(precision),
                behind,
                behind.square().sum(dim=-1, keepdim=True),
                observed,
                (behind * observed).sum(dim=-1, keepdim=True),
            ],
            dim=-1,
        )
        # float64, because colors at a pixel may be equal within rounding, and its block then is all but singular.
        sums = summed(pixel, (precision * moments).double(), height * width).reshape(height, width, 9)
        if round_ >= ROUNDS // 2:
            prior = 1 / (PRIOR_SCALE**2 + (layers - expected).square().amax(dim=-1, keepdim=True))
        opacity = smallest_matte(layers[..., :1], layers[..., 1:])
        smoothness = _smoothness(across, opacity, 1), _smoothness(down, opacity, 0)
        layers = _solve(sums, *smoothness, prior, expected, layers)
        # What hides more than half is not taken for clear, as behind binoculars.
        clearest = max(1, round((1 - CLEAR_SHARE) * height * width))
        brightest = layers[..., 0].flatten().kthvalue(clearest).values.clamp_min(0.5)
        layers = torch.cat([layers[..., :1] / brightest, layers[..., 1:]], dim=-1).clamp(0, 1)
        transmitted, added = layers.reshape(-1, 4)[pixel].split((1, 3), dim=-1)
        seen = torch.cat([weight * transmitted * (observed - added), weight * transmitted.square()], dim=-1)
        total = summed(point, seen, samples.points)
        colors = torch.where(total[:, 3:] > 0.01, total[:, :3] / total[:, 3:].clamp_min(1e-6), colors).clamp(0, 1)
        # Of the color from the other samples: a point seen once says nothing.
        others = (total[:, 3:][point] - seen[:, 3:]).clamp_min(1e-6)
        uncertainty = transmitted.square() / others
        residual = observed - transmitted * colors[point] - added
    outliers = residual.square().mean(dim=-1, keepdim=True) > (OUTLIER_SCALE * scale) ** 2
    counts = torch.cat([outliers.to(residual), torch.ones_like(residual[:, :1])], dim=-1)
    around = local_mean(summed(pixel, counts, height * width).reshape(height, width, 2), OCCLUSION_RADIUS)
    unexplained = around[..., :1] / around[..., 1:]  # 0 / 0 is NaN
    return LayerEstimate(
        layers[..., :1], layers[..., 1:], torch.ones_like(layers[..., :1]), unexplained, scale.clamp_max(1.0), colors
    )


def robust_deviation(residuals: Tensor) -> Tensor:
    """Standard deviation of residuals, [], from the median of their sizes; at least that of rounded photos."""
    return 1.48 * residuals.abs().median() + GRAY_LEVEL


def _photo_differences(mean: Tensor, deviation: Tensor, dimension: int) -> Tensor:
    """Squares of the differences of T and B that the photos suggest between neighbors along a dimension.

    Returns:
        [h, w - 1, 4] or [h - 1, w, 4].
    """
    change = mean.diff(dim=dimension).square().amax(dim=-1, keepdim=True)
    typical = deviation.nanmedian().clamp_min(GRAY_LEVEL)
    # Where the deviation is unknown, no edge of it is known.
    relative = (deviation.diff(dim=dimension) / typical).nan_to_num(0.0).square()
    return torch.cat([change + relative, change.expand(-1, -1, 3)], dim=-1)


def _smoothness(differences: Tensor, opacity: Tensor, dimension: int) -> Tensor:
    """Inverse variances of the differences of T and B between neighbors along a dimension.

    In the clear they differ no more than the photos do, where the opacity is 1 by 1 / MEAN_CONTRAST times as much, and
    between in proportion.

    Args:
        differences: see `_photo_differences`; the result has their shape.
        opacity: estimated so far, [h, w, 1] in [0, 1]; of the two neighbors the larger one counts.
        dimension: 0 or 1.
    """
    neighbors = opacity.shape[dimension] - 1
    most = torch.maximum(opacity.narrow(dimension, 0, neighbors), opacity.narrow(dimension, 1, neighbors))
    ratio = 1 + (1 / MEAN_CONTRAST - 1) * most
    return 1 / (ratio.square() * differences + SMOOTHNESS_FLOOR**2)


def _solve(sums: Tensor, across: Tensor, down: Tensor, prior: Tensor, expected: Tensor, layers: Tensor) -> Tensor:
    """Minimize the quadratic problem by conjugate gradients, preconditioned pixel by pixel.

    Args:
        sums: weighted moments [h, w, 9]: 1, C, C C, I, C I.
        across, down: inverse variances [h, w - 1, 4], [h - 1, w, 4] of the differences of neighbors.
        prior: inverse variance [h, w, 1] of the differences from `expected` [h, w, 4].
        layers: T and B to start from, [h, w, 4].

    Returns:
        T and B [h, w, 4].
    """
    # Channels first: each operation below then runs along whole rows of pixels.
    sums, across, down, prior, expected, layers = (
        x.double().movedim(-1, 0).contiguous() for x in (sums, across, down, prior, expected, layers)
    )
    count, behind, squares, observed, products = sums.split((1, 3, 1, 3, 1))
    own = torch.cat([squares, count.expand_as(behind)]) + prior
    diagonal = own.clone()
    diagonal[:, :, 1:] += across
    diagonal[:, :, :-1] += across
    diagonal[:, 1:] += down
    diagonal[:, :-1] += down
    # A pixel's 4 x 4 matrix is a diagonal, and `behind` between T and B: eliminating B leaves one equation for T.
    inverse = 1 / diagonal[1:]
    ratio = behind * inverse
    remainder = 1 / (diagonal[:1] - (behind * ratio).sum(dim=0, keepdim=True))

    def system(x: Tensor) -> Tensor:
        y = own * x
        y[:1] += (behind * x[1:]).sum(dim=0, keepdim=True)
        y[1:].addcmul_(behind, x[:1])
        flow = x.diff(dim=2).mul_(across)
        y[:, :, 1:] += flow
        y[:, :, :-1] -= flow
        flow = x.diff(dim=1).mul_(down)
        y[:, 1:] += flow
        y[:, :-1] -= flow
        return y

    def condition(x: Tensor) -> Tensor:
        t = (x[:1] - (ratio * x[1:]).sum(dim=0, keepdim=True)) * remainder
        return torch.cat([t, (x[1:] * inverse).addcmul_(ratio, t, value=-1)])

    layers = layers.clone()
    residual = torch.cat([products, observed]) + prior * expected - system(layers)
    direction = condition(residual)
    energy = (residual * direction).sum()

    def descend() -> None:
        image = system(direction)
        step = energy / (direction * image).sum().clamp_min(1e-20)
        layers.addcmul_(step, direction)
        residual.addcmul_(step, image, value=-1)
        conditioned = condition(residual)
        left = (residual * conditioned).sum()
        direction.mul_(left / energy.clamp_min(1e-20)).add_(conditioned)
        energy.copy_(left)

    repeat(descend, CONJUGATE_GRADIENT_STEPS, layers.device)
    return layers.movedim(0, -1).float()
