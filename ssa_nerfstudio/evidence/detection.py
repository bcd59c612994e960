"""Is there a static artifact, and where: a test on what the views have in common, with a null from the capture itself.

The edges of a scene move from view to view, and at a fixed pixel their gradients average out; the edges of an artifact
stay. The evidence of a pixel is the length of its mean gradient over its standard error. A distant scene hardly moves
during a short walk, but what moves of it moves together: where blocks of views differ as if their mean were displaced,
edges do not count. How much evidence chance and habit (a horizon at the same height, an object always in the middle,
vignetting) bring about is learned from the capture: its views, shifted at random by a few pixels, keep all of that and
lose only what stays in place to the pixel.
docs/detect.md derives it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from scipy.special import betaincinv
from torch import Tensor, nn

from ssa_nerfstudio.evidence.static_area import HALF_A_GREY_LEVEL, EnclosedAreas, StaticArea
from ssa_nerfstudio.evidence.statistics import ImageStatistics

DRAWS = 200
"""Captures with shifted views that the null is made of."""
EVIDENCE_NEEDED = (6.0, 7.0)
"""Mean gradient over its standard error, from which on a pixel is a static edge, at the fine and the coarse scale."""
FAINTEST_GRADIENT = 1 / 255
"""Mean gradients below this (white = 1, a working pixel) never count: codecs and sensors have them."""
COARSE = 4
"""The second scale: this many working pixels a side, for soft edges (a finger, thick drops)."""
LEAST_SHARES = (0.003, 0.015)
"""Share of static edges above the null's mean, at the fine and the coarse scale, below which nothing is reported."""
LEAST_PLAIN = 0.01
"""Share of the frame that is opaque and enclosed by static edges, from which on their number does not matter."""
WINDOWS = (21, 11)
"""Side of the window in which a displacement is fitted, pixels at the fine and at the coarse scale; odd."""
DISPLACED_SHARES = (0.03, 0.05)
"""Where displacements explain more of the blocks' deviations than this (fine, coarse), edges move and do not count."""
STILL_SHARE = 0.1
"""Connected static edges belong to the artifact if this share of them does not move: where it is soft, or beside a
distant scene, an artifact's own edge seems to move in places (hysteresis, as in Canny's edges)."""
LARGEST_SHIFT = 16
"""Views are shifted by up to this many working pixels in each direction, in steps of COARSE."""
SIGNIFICANCE = 0.01
"""Largest p-value that is reported as an artifact."""
LEAST_VIEWS = 6
"""With fewer views than this, standard errors mean nothing and nothing is reported."""
CLIPPED = 1.5 / 255
"""Colors this near to black or white in all channels say nothing: whatever exceeds the range looks constant."""
OPAQUE_SHARE = 0.25
"""Share of the artifact's area that has to be opaque for that verdict."""
_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Detection:
    """What the test says of one camera."""

    verdict: Literal["none", "faint", "opaque"]
    """none; faint: the scene shows through everywhere; opaque: it is hidden somewhere."""
    coverage: float
    """Share of the frame that `mask` covers; 0 for verdict none."""
    p_value: float
    """Share of shifted captures (and this one) with as many static edges as this one."""
    p_interval: tuple[float, float]
    """95 % interval of the false-alarm rate (Clopper-Pearson)."""
    views: int
    """How many views were looked at."""
    shares: tuple[float, float]
    """Share of static edges at the fine and at the coarse scale."""
    null_shares: tuple[float, float]
    """The same, mean over the shifted captures."""
    evidence: Tensor
    """[h, w] at the working resolution; 0 where the edges move."""
    area: StaticArea
    """Where the artifact is; nowhere for verdict none."""

    @property
    def mask(self) -> Tensor:
        """[H, W] bool: True where the artifact is."""
        return self.area.inside

    @property
    def slight(self) -> bool:
        """Verdict none although the static edges are no chance: there are too few of them to report."""
        return self.verdict == "none" and self.p_value <= SIGNIFICANCE


def detect(statistics: ImageStatistics, draws: int = DRAWS, seed: int = 0) -> Detection:
    """Test whether the views have a static artifact in front of them.

    Args:
        statistics: of all views of one camera, in the order of the capture.
        draws: shifted captures to compare with.
        seed: of the shifts; global random state is neither used nor changed.
    """
    views = int(statistics.views.max())
    moments, still = _look(statistics)
    fields = [_evidence(at_scale.sum(dim=0), len(at_scale)) for at_scale in moments]
    shares, evidence = _shares(fields, still), fields[0] * still[0]
    nowhere = _nowhere(statistics)
    if views < LEAST_VIEWS:
        return Detection("none", 0.0, 1.0, (0.0, 1.0), views, shares, (0.0, 0.0), evidence, nowhere)
    null = list(_null_shares(moments, still, draws, np.random.default_rng(seed)))
    reached = sum(_strength(draw) >= _strength(shares) for draw in null)
    p_value = (1 + reached) / (1 + draws)
    fine, coarse = (float(np.mean(scale)) for scale in zip(*null, strict=True))
    excess = shares[0] - fine, shares[1] - coarse
    interval = _interval(reached, draws)
    enclosed = EnclosedAreas.by(_edges(fields, still), statistics)
    if p_value > SIGNIFICANCE or (_strength(excess) < 1 and enclosed.opaque_share < LEAST_PLAIN):
        return Detection("none", 0.0, p_value, interval, views, shares, (fine, coarse), evidence, nowhere)
    area = enclosed.area()
    coverage = float(area.inside.float().mean())
    verdict = "opaque" if enclosed.opaque_share >= OPAQUE_SHARE * coverage else "faint"
    return Detection(verdict, coverage, p_value, interval, views, shares, (fine, coarse), evidence, area)


def static_area(statistics: ImageStatistics) -> StaticArea:
    """The area of static edges, and everything where there are too few views.

    Where there are too few edges to report, what no view changes by half a gray level: no scene is so constant, unless
    it is clipped to black or white.
    """
    if int(statistics.views.max()) < LEAST_VIEWS:
        return StaticArea.plain(torch.ones(statistics.size, dtype=torch.bool))
    moments, still = _look(statistics)
    fields = [_evidence(at_scale.sum(dim=0), len(at_scale)) for at_scale in moments]
    enclosed = EnclosedAreas.by(_edges(fields, still), statistics)
    if _strength(_shares(fields, still)) < 1 and enclosed.opaque_share < LEAST_PLAIN:
        mean, deviation = statistics.mean(), statistics.deviation()
        constant = deviation[..., 0] < HALF_A_GREY_LEVEL
        if not constant.all():
            constant &= ~((mean < CLIPPED).all(dim=-1) | (mean > 1 - CLIPPED).all(dim=-1))
        return StaticArea.plain(constant.cpu())
    return enclosed.area()


def _nowhere(statistics: ImageStatistics) -> StaticArea:
    return StaticArea.plain(torch.zeros(statistics.size, dtype=torch.bool))


def _look(statistics: ImageStatistics) -> tuple[list[Tensor], list[Tensor]]:
    """Moments of the blocks' gradients [K, 3, h, w], and where the scene does not move [h, w], fine and coarse."""
    means, seen = statistics.brightness.means()
    # Where a block shows nothing of a pixel, the mean of the others stands in.
    average = (means * seen).sum(dim=0) / seen.sum(dim=0).clamp_min(1)
    means = torch.where(seen, means, average).float() / statistics.scale
    hidden = (~seen.any(dim=0)).float()[None, None]
    coarse = nn.functional.avg_pool2d(means[:, None], COARSE, ceil_mode=True)[:, 0]
    coarse_hidden = nn.functional.max_pool2d(hidden, COARSE, ceil_mode=True)
    moments = [_moments(means, hidden), _moments(coarse, coarse_hidden)]
    parameters = zip((means, coarse), moments, WINDOWS, DISPLACED_SHARES, strict=True)
    return moments, [
        _displaced_share(images, at_scale[:, :2].mean(dim=0), window) <= largest
        for images, at_scale, window, largest in parameters
    ]


def _moments(images: Tensor, hidden: Tensor) -> Tensor:
    """Gradient along x and y and squared length of both [K, 3, h, w] of images [K, h, w].

    Central differences, 0 at the border and beside what no view shows [1, 1, h, w].
    """
    moments = images.new_zeros(len(images), 3, *images.shape[1:])
    moments[:, 0, :, 1:-1] = (images[:, :, 2:] - images[:, :, :-2]) / 2
    moments[:, 1, 1:-1] = (images[:, 2:] - images[:, :-2]) / 2
    moments *= nn.functional.max_pool2d(hidden, 3, stride=1, padding=1) == 0
    moments[:, 2] = moments[:, :2].square().sum(dim=1)
    return moments


def _displaced_share(images: Tensor, gradient: Tensor, window: int) -> Tensor:
    """Share of the deviations of images [K, h, w] from their mean that displacing this mean explains, [h, w] in [0, 1].

    In the window around each pixel, every image has its own displacement d, fitted by least squares to deviation =
    constant + gain x mean + d . gradient of the mean [2, h, w] (Lucas and Kanade 1981). Constant and gain are there for
    exposure, and for soft artifacts: behind their edges the scene fades, which alone looks much like a displacement.
    What these two explain does not count.
    """
    basis = torch.cat([images.mean(dim=0, keepdim=True), gradient])
    levels = _averaged(basis, window)
    mean_mean, mean_x, mean_y = _averaged(basis[:1] * basis, window) - levels[:1] * levels
    gain = torch.stack([mean_x, mean_y]) / mean_mean.clamp_min(HALF_A_GREY_LEVEL**2)
    xx, yy = _averaged(gradient.square(), window) - levels[1:].square() - gain * torch.stack([mean_x, mean_y])
    xy = (_averaged(gradient[:1] * gradient[1:], window) - levels[1:2] * levels[2:])[0] - gain[0] * mean_y
    # Along a straight edge no displacement can be told: 1 % more variance keeps it near 0 there.
    ridge = 0.01 * (xx + yy).clamp_min(torch.finfo(images.dtype).eps)
    xx, yy = xx + ridge, yy + ridge
    determinant = (xx * yy - xy.square()).clamp_min(ridge.square())
    explained, total = torch.zeros_like(images[0]), torch.zeros_like(images[0])
    for deviation in (images - basis[0])[:, None]:
        level = _averaged(deviation, window)
        with_mean, *with_gradient = _averaged(basis * deviation, window) - levels * level
        x, y = torch.stack(with_gradient) - gain * with_mean
        explained += (yy * x.square() - 2 * xy * x * y + xx * y.square()) / determinant
        total += (_averaged(deviation.square(), window) - level.square())[0]
    return (explained / total.clamp_min(len(images) * HALF_A_GREY_LEVEL**2)).clamp(0, 1)


def _averaged(images: Tensor, window: int) -> Tensor:
    """Means over windows of this odd side, [n, h, w]; at the border of what lies inside."""
    for sides in ((window, 1), (1, window)):
        margins = sides[0] // 2, sides[1] // 2
        images = nn.functional.avg_pool2d(images, sides, stride=1, padding=margins, count_include_pad=False)
    return images


def _evidence(sums: Tensor, count: int) -> Tensor:
    """Length of the mean gradient over its standard error [h, w], of `count` moments' sums [3, h, w].

    The error has a floor, so that a gradient fainter than FAINTEST_GRADIENT stays below EVIDENCE_NEEDED.
    """
    mean = sums / count
    length = mean[:2].square().sum(dim=0)
    error = (mean[2] - length).clamp_min_(0).div_(max(1, count - 1))
    return (length / error.add_((FAINTEST_GRADIENT / EVIDENCE_NEEDED[0]) ** 2)).sqrt_()


def _null_shares(
    moments: list[Tensor], still: list[Tensor], draws: int, rng: np.random.Generator
) -> Iterator[tuple[float, float]]:
    """Shares of static edges after every block was shifted in its own random way, the same at both scales.

    Where the scene moves is left out as in the capture itself. Found in the capture, it takes away more of its edges
    than of a shifted one's: p-values err upwards.
    """
    reach = LARGEST_SHIFT // COARSE
    steps = COARSE, 1
    framed = [_framed(at_scale, reach * step) for at_scale, step in zip(moments, steps, strict=True)]
    for _ in range(draws):
        ways = rng.integers(0, 2 * reach + 1, (len(moments[0]), 2)).tolist()
        fields = []
        for at_scale, padded, step in zip(moments, framed, steps, strict=True):
            h, w = at_scale.shape[2:]
            sums = torch.zeros_like(at_scale[0])
            for block, (y, x) in zip(padded, ways, strict=True):
                sums += block[:, y * step : y * step + h, x * step : x * step + w]
            fields.append(_evidence(sums, len(at_scale)))
        yield _shares(fields, still)


def _framed(moments: Tensor, margin: int) -> Tensor:
    """Continued on all sides as if the frame were a torus, however small it is."""
    h, w = moments.shape[2:]
    rows = torch.arange(-margin, h + margin, device=moments.device) % h
    columns = torch.arange(-margin, w + margin, device=moments.device) % w
    return moments[:, :, rows][:, :, :, columns]


def _shares(fields: list[Tensor], still: list[Tensor]) -> tuple[float, float]:
    """Shares of the frame that are static edges which do not move."""
    fine, coarse = (
        float(((field >= needed) & unmoved).float().mean())
        for field, unmoved, needed in zip(fields, still, EVIDENCE_NEEDED, strict=True)
    )
    return fine, coarse


def _strength(shares: tuple[float, ...]) -> float:
    return max(share / least for share, least in zip(shares, LEAST_SHARES, strict=True))


def _interval(reached: int, draws: int) -> tuple[float, float]:
    """95 % Clopper-Pearson interval of a rate of which `reached` of `draws` were seen."""
    low = 0.0 if reached == 0 else float(betaincinv(reached, draws - reached + 1, 0.025))
    high = 1.0 if reached == draws else float(betaincinv(reached + 1, draws - reached, 0.975))
    return low, high


def _edges(fields: list[Tensor], still: list[Tensor]) -> np.ndarray:
    """The artifact's edges at the working resolution, uint8 [h, w]: coarse ones where there are too few fine ones."""
    h, w = fields[0].shape
    fine, coarse = (
        _settled((field >= needed).cpu().numpy().astype(np.uint8), unmoved.cpu().numpy())
        for field, unmoved, needed in zip(fields, still, EVIDENCE_NEEDED, strict=True)
    )
    return fine if fine.mean() >= LEAST_SHARES[0] else np.kron(coarse, np.ones((COARSE, COARSE), np.uint8))[:h, :w]


def _settled(edges: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Those connected edges of which a share of STILL_SHARE does not move: uint8 [h, w]."""
    count, labels = cv2.connectedComponents(cv2.dilate(edges, _AROUND))
    total = np.bincount(labels[edges > 0], minlength=count)
    unmoved = np.bincount(labels[(edges > 0) & still], minlength=count)
    return edges * (unmoved >= STILL_SHARE * total)[np.asarray(labels, np.int32)]
