"""Is there a static artifact, and where: a test on what the views have in common, with a null from the capture itself.

The edges of a scene move from view to view, and at a fixed pixel their gradients average out; the edges of an artifact
stay. The evidence of a pixel is the length of its mean gradient over its standard error. How much evidence chance and
habit (a horizon at the same height, an object always in the middle, vignetting) bring about is learned from the
capture: its views, shifted at random by a few pixels, keep all of that and lose only what stays in place to the pixel.
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

from ssa_nerfstudio.overlay.formation import adds_light
from ssa_nerfstudio.overlay.statistics import ImageStatistics

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
LARGEST_SHIFT = 16
"""Views are shifted by up to this many working pixels in each direction, in steps of COARSE."""
SIGNIFICANCE = 0.01
"""Largest p-value that is reported as an artifact."""
LEAST_BLOCKS = 6
"""With fewer blocks of views than this, standard errors mean nothing and nothing is reported."""
LOW_DEVIATION = 0.2
"""Deviation relative to the capture's (its 75th percentile) below which a pixel can be behind an opaque artifact."""
HALF_A_GREY_LEVEL = 0.5 / 255
"""Deviations below this are low in any capture."""
OPAQUE_SHARE = 0.25
"""Share of the artifact's area that has to be opaque for that verdict."""
NEAR = 16
"""Working pixels around a static edge in which its artifact may go on: the inside of letters, thin mud."""
EDGE_SUPPORT = 0.5
"""Share of an area's outline that has to be static edges: a plain artifact has them all around, a plain sky has not."""
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
    """[h, w] at the working resolution."""
    mask: Tensor
    """[H, W] bool: True where the artifact is (empty for verdict none)."""


def detect(statistics: ImageStatistics, draws: int = DRAWS, seed: int = 0) -> Detection:
    """Test whether the views have a static artifact in front of them.

    Args:
        statistics: of all views of one camera, in the order of the capture.
        draws: shifted captures to compare with.
        seed: of the shifts; global random state is neither used nor changed.
    """
    views = int(statistics.views.max())
    moments = _moments(statistics)
    blocks = len(moments[0])
    fields = [_evidence(at_scale.sum(dim=0), blocks) for at_scale in moments]
    shares = _shares(fields)
    nothing = torch.zeros(statistics.size, dtype=torch.bool)
    if blocks < LEAST_BLOCKS:
        return Detection("none", 0.0, 1.0, (0.0, 1.0), views, shares, (0.0, 0.0), fields[0], nothing)
    null = list(_null_shares(moments, draws, np.random.default_rng(seed)))
    reached = sum(_strength(draw) >= _strength(shares) for draw in null)
    p_value = (1 + reached) / (1 + draws)
    fine, coarse = (float(np.mean(scale)) for scale in zip(*null, strict=True))
    excess = shares[0] - fine, shares[1] - coarse
    interval = _interval(reached, draws)
    if p_value > SIGNIFICANCE or _strength(excess) < 1:
        return Detection("none", 0.0, p_value, interval, views, shares, (fine, coarse), fields[0], nothing)
    mask, opaque_share = _area(statistics, fields)
    coverage = float(mask.float().mean())
    verdict = "opaque" if opaque_share >= OPAQUE_SHARE * coverage else "faint"
    return Detection(verdict, coverage, p_value, interval, views, shares, (fine, coarse), fields[0], mask)


@dataclass(frozen=True)
class StaticArea:
    """Where an artifact would be, whatever the verdict, and of which kind: what an overlay starts from."""

    inside: Tensor
    """[H, W] bool: static edges, and plain areas among them."""
    near: Tensor
    """[H, W] bool: that, and all within NEAR working pixels of a static edge."""
    adds_light: bool
    """The artifact shines and hides nothing (`formation.adds_light`)."""


def static_area(statistics: ImageStatistics) -> StaticArea:
    """The area of static edges; nothing where there are too few to report, everything where there are too few views."""
    moments = _moments(statistics)
    fields = [_evidence(at_scale.sum(dim=0), len(at_scale)) for at_scale in moments]
    if len(moments[0]) < LEAST_BLOCKS:
        everything = torch.ones(statistics.size, dtype=torch.bool)
        return StaticArea(everything, everything, False)
    if _strength(_shares(fields)) < 1:
        nothing = torch.zeros(statistics.size, dtype=torch.bool)
        return StaticArea(nothing, nothing, False)
    inside, _ = _area(statistics, fields)
    edges = _edges(fields)
    distance = cv2.distanceTransform(1 - edges, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    near = inside | torch.from_numpy(_at_full_size(distance <= NEAR, statistics))
    mean, deviation = _at_working_size(statistics.mean(), statistics), _deviation(statistics)
    return StaticArea(inside, near, adds_light(mean.mean(axis=0), deviation, (edges > 0) & ~_low(deviation)))


def _moments(statistics: ImageStatistics) -> list[Tensor]:
    """Of each block's brightness, gradient along x and y and squared length of both: [K, 3, h, w], fine and coarse."""
    means, seen = statistics.brightness.means()
    # Where a block shows nothing of a pixel, the mean of the others stands in.
    average = (means * seen).sum(dim=0) / seen.sum(dim=0).clamp_min(1)
    means = torch.where(seen, means, average).float() / statistics.scale
    hidden = (~seen.any(dim=0)).float()[None, None]
    coarse = nn.functional.avg_pool2d(means[:, None], COARSE, ceil_mode=True)[:, 0]
    coarse_hidden = nn.functional.max_pool2d(hidden, COARSE, ceil_mode=True)
    return [_moments_of(means, hidden), _moments_of(coarse, coarse_hidden)]


def _moments_of(images: Tensor, hidden: Tensor) -> Tensor:
    """`_moments` at one scale: central differences, 0 at the border and beside what no view shows [1, 1, h, w]."""
    moments = images.new_zeros(len(images), 3, *images.shape[1:])
    moments[:, 0, :, 1:-1] = (images[:, :, 2:] - images[:, :, :-2]) / 2
    moments[:, 1, 1:-1] = (images[:, 2:] - images[:, :-2]) / 2
    moments *= nn.functional.max_pool2d(hidden, 3, stride=1, padding=1) == 0
    moments[:, 2] = moments[:, :2].square().sum(dim=1)
    return moments


def _evidence(sums: Tensor, count: int) -> Tensor:
    """Length of the mean gradient over its standard error, [h, w].

    The error has a floor, so that a gradient fainter than FAINTEST_GRADIENT stays below EVIDENCE_NEEDED.
    """
    mean = sums / count
    length = mean[:2].square().sum(dim=0)
    error = (mean[2] - length).clamp_min_(0).div_(max(1, count - 1))
    return (length / error.add_((FAINTEST_GRADIENT / EVIDENCE_NEEDED[0]) ** 2)).sqrt_()


def _null_shares(moments: list[Tensor], draws: int, rng: np.random.Generator) -> Iterator[tuple[float, float]]:
    """Shares of static edges after every block was shifted in its own random way, the same at both scales."""
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
        yield _shares(fields)


def _framed(moments: Tensor, margin: int) -> Tensor:
    """Continued on all sides as if the frame were a torus, however small it is."""
    h, w = moments.shape[2:]
    rows = torch.arange(-margin, h + margin, device=moments.device) % h
    columns = torch.arange(-margin, w + margin, device=moments.device) % w
    return moments[:, :, rows][:, :, :, columns]


def _shares(fields: list[Tensor]) -> tuple[float, float]:
    fine, coarse = (
        float((field >= needed).float().mean()) for field, needed in zip(fields, EVIDENCE_NEEDED, strict=True)
    )
    return fine, coarse


def _strength(shares: tuple[float, ...]) -> float:
    return max(share / least for share, least in zip(shares, LEAST_SHARES, strict=True))


def _interval(reached: int, draws: int) -> tuple[float, float]:
    """95 % Clopper-Pearson interval of a rate of which `reached` of `draws` were seen."""
    low = 0.0 if reached == 0 else float(betaincinv(reached, draws - reached + 1, 0.025))
    high = 1.0 if reached == draws else float(betaincinv(reached + 1, draws - reached, 0.975))
    return low, high


def _area(statistics: ImageStatistics, fields: list[Tensor]) -> tuple[Tensor, float]:
    """Static edges, widened, and the areas of low deviation among them, [H, W] bool; and the share that is opaque."""
    edges, low = _edges(fields), _low(_deviation(statistics)).astype(np.uint8)
    plain = _supported(low, cv2.dilate(edges, _AROUND, iterations=2))
    mask = _at_full_size(cv2.dilate(edges, _AROUND) | plain, statistics)
    return torch.from_numpy(mask), float((plain | (edges & low)).mean())


def _edges(fields: list[Tensor]) -> np.ndarray:
    """Static edges at the working resolution, uint8 [h, w]: the coarse ones where there are too few fine ones."""
    h, w = fields[0].shape
    fine, coarse = (
        (field >= needed).cpu().numpy().astype(np.uint8) for field, needed in zip(fields, EVIDENCE_NEEDED, strict=True)
    )
    return fine if fine.mean() >= LEAST_SHARES[0] else np.kron(coarse, np.ones((COARSE, COARSE), np.uint8))[:h, :w]


def _low(deviation: np.ndarray) -> np.ndarray:
    """Where the views agree so far that an opaque artifact may be the reason, bool [h, w]."""
    return deviation < max(LOW_DEVIATION * np.quantile(deviation, 0.75), HALF_A_GREY_LEVEL)


def _deviation(statistics: ImageStatistics) -> np.ndarray:
    return _at_working_size(statistics.deviation(), statistics)[0]


def _at_working_size(layer: Tensor, statistics: ImageStatistics) -> np.ndarray:
    """A layer [H, W, C] of the frame as [C, h, w]; rows and columns that fill no block are dropped."""
    reduction = statistics.brightness.reduction
    h, w = (side // reduction for side in statistics.size)
    planes = layer[: h * reduction, : w * reduction].permute(2, 0, 1)[None].float()
    return nn.functional.avg_pool2d(planes, reduction)[0].cpu().numpy()


def _at_full_size(mask: np.ndarray, statistics: ImageStatistics) -> np.ndarray:
    """A mask [h, w] at the working resolution as bool [H, W]."""
    height, width = statistics.size
    reduction = statistics.brightness.reduction
    enlarged = np.kron(mask.astype(np.uint8), np.ones((reduction, reduction), np.uint8))
    return np.pad(enlarged, ((0, height - enlarged.shape[0]), (0, width - enlarged.shape[1])), mode="edge") > 0


def _supported(areas: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Those connected areas whose outline is made of edges for a share of EDGE_SUPPORT: uint8 [h, w]."""
    supported = np.zeros_like(areas)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(areas, connectivity=4)
    for label in range(1, count):
        x, y, w, h, size = boxes[label]
        if size < COARSE**2:
            continue
        box = slice(max(0, y - 1), y + h + 1), slice(max(0, x - 1), x + w + 1)
        inside = (labels[box] == label).astype(np.uint8)
        outline = cv2.dilate(inside, _AROUND) > inside
        if not outline.any() or edges[box][outline].mean() >= EDGE_SUPPORT:
            supported[box] |= inside
    return supported
