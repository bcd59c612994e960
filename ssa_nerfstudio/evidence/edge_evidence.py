"""Evidence of static edges: the views' mean gradient over its standard error, at two scales.

The edges of a scene move from view to view, and their gradients average out at a fixed pixel; the edges of an artifact
stay. Where blocks of views differ as if their mean were displaced, edges belong to the scene and do not count.
docs/detect.md derives it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.displacement import displaced_share
from ssa_nerfstudio.evidence.statistics import GRAY_LEVEL, ImageStatistics

EVIDENCE_THRESHOLDS = (6.0, 7.0)
"""Evidence from which on a pixel is a static edge, at the fine and the coarse scale."""
MIN_GRADIENT = GRAY_LEVEL
"""Mean gradients below this (white = 1, per working pixel) never count: codecs and sensors cause them."""
COARSE_FACTOR = 4
"""Working pixels a side of a pixel of the coarse scale, which shows soft edges (a finger, thick drops)."""
MIN_EDGE_SHARES = (0.003, 0.003 * COARSE_FACTOR)
"""Share of static edges above the null's mean, at the fine and the coarse scale, below which nothing is reported: a
line covers COARSE_FACTOR times as much of the coarse frame."""
DISPLACEMENT_WINDOWS = (21, 11)
"""Side of the window in which a displacement is fitted, pixels of the fine and of the coarse scale; odd."""
MAX_DISPLACED_SHARES = (0.03, 0.05)
"""Where displacements explain more of the blocks' deviations than this (fine, coarse), edges move and do not count."""
MIN_STILL_SHARE = 0.1
"""Connected static edges belong to the artifact if this share of them does not move: where it is soft, or beside a
distant scene, an artifact's own edge seems to move in places (hysteresis, as in Canny's edges)."""
_NEIGHBORS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class EdgeEvidence:
    """Gradients and evidence of K blocks of views, at the fine and at the coarse scale."""

    moments: list[Tensor]
    """Per scale [K, 3, h, w]: gradient along x and y, and its squared length."""
    still: list[Tensor]
    """Per scale [h, w] bool: where the scene does not move."""
    fields: list[Tensor]
    """Per scale [h, w]: `evidence_field` of all blocks."""

    @property
    def shares(self) -> tuple[float, float]:
        """`edge_shares` of the fields."""
        return edge_shares([field[None] for field in self.fields], self.still)[0]

    @cached_property
    def mask(self) -> np.ndarray:
        """The artifact's edges at the working resolution, uint8 [h, w]: coarse ones where fine ones are too few."""
        h, w = self.fields[0].shape
        fine, coarse = (
            _mostly_still((field >= threshold).cpu().numpy().astype(np.uint8), still.cpu().numpy())
            for field, still, threshold in zip(self.fields, self.still, EVIDENCE_THRESHOLDS, strict=True)
        )
        if fine.mean() >= MIN_EDGE_SHARES[0]:
            return fine
        return np.kron(coarse, np.ones((COARSE_FACTOR, COARSE_FACTOR), np.uint8))[:h, :w]

    @property
    def outlines(self) -> np.ndarray:
        """`mask`, and edges of three standard errors that do not move: uint8 [h, w].

        An edge is as strong as its contrast, which changes along an outline with the scene behind it.
        """
        weak = (self.fields[0] >= EVIDENCE_THRESHOLDS[0] / 2) & self.still[0]
        return self.mask | weak.cpu().numpy().astype(np.uint8)


def measure_edges(statistics: ImageStatistics) -> EdgeEvidence:
    """Measure the evidence of static edges.

    Args:
        statistics: of all views of one camera, in the order of the capture.
    """
    means, hidden = block_images(statistics)
    coarse = nn.functional.avg_pool2d(means[:, None], COARSE_FACTOR, ceil_mode=True)[:, 0]
    coarse_hidden = nn.functional.max_pool2d(hidden, COARSE_FACTOR, ceil_mode=True)
    moments = [gradient_moments(means, hidden), gradient_moments(coarse, coarse_hidden)]
    parameters = zip((means, coarse), moments, DISPLACEMENT_WINDOWS, MAX_DISPLACED_SHARES, strict=True)
    still = [
        displaced_share(images, at_scale[:, :2].mean(dim=0), window) <= max_share
        for images, at_scale, window, max_share in parameters
    ]
    return EdgeEvidence(moments, still, [evidence_field(at_scale.sum(dim=0), len(at_scale)) for at_scale in moments])


def block_images(statistics: ImageStatistics, blocks: Sequence[int] | None = None) -> tuple[Tensor, Tensor]:
    """Mean brightness of blocks [K, h, w] in [0, 1], and 1 where no view shows a pixel, else 0: [1, 1, h, w].

    A block that shows nothing of a pixel gets the mean of the others there.

    Args:
        statistics: of the views.
        blocks: see `BrightnessBlocks.means`.
    """
    means, seen = statistics.brightness.means(blocks)
    average = (means * seen).sum(dim=0) / seen.sum(dim=0).clamp_min(1)
    means = torch.where(seen, means, average).float() / statistics.scale
    return means, (~seen.any(dim=0)).float()[None, None]


def evidence_field(sums: Tensor, count: int) -> Tensor:
    """Length of the mean gradient over its standard error.

    The error has a floor that keeps a gradient below MIN_GRADIENT below the fine scale's threshold.

    Args:
        sums: of moments over `count` blocks, [3, ..., h, w].
        count: of blocks.

    Returns:
        [..., h, w], not negative.
    """
    mean = sums / count
    length = mean[:2].square().sum(dim=0)
    error = (mean[2] - length).clamp_min_(0).div_(max(1, count - 1))
    return (length / error.add_((MIN_GRADIENT / EVIDENCE_THRESHOLDS[0]) ** 2)).sqrt_()


def edge_shares(fields: list[Tensor], still: list[Tensor]) -> list[tuple[float, float]]:
    """Shares of the frame, at the fine and the coarse scale, that are static edges which do not move.

    Args:
        fields: of n captures, at each scale [n, h, w].
        still: as in `EdgeEvidence`.

    Returns:
        A pair for each capture.
    """
    fine, coarse = (
        ((field >= threshold) & unmoved).float().mean(dim=(1, 2)).tolist()
        for field, unmoved, threshold in zip(fields, still, EVIDENCE_THRESHOLDS, strict=True)
    )
    return [*zip(fine, coarse, strict=True)]


def gradient_moments(images: Tensor, hidden: Tensor) -> Tensor:
    """Gradient along x and y and its squared length [K, 3, h, w] of images [K, h, w].

    Central differences, 0 at the border and beside pixels that no view shows (`hidden` [1, 1, h, w]).
    """
    moments = images.new_zeros(len(images), 3, *images.shape[1:])
    moments[:, 0, :, 1:-1] = (images[:, :, 2:] - images[:, :, :-2]) / 2
    moments[:, 1, 1:-1] = (images[:, 2:] - images[:, :-2]) / 2
    moments *= nn.functional.max_pool2d(hidden, 3, stride=1, padding=1) == 0
    moments[:, 2] = moments[:, :2].square().sum(dim=1)
    return moments


def _mostly_still(edges: np.ndarray, still: np.ndarray) -> np.ndarray:
    """The connected edges of which at least MIN_STILL_SHARE does not move: uint8 [h, w]."""
    count, labels = cv2.connectedComponents(cv2.dilate(edges, _NEIGHBORS))
    total = np.bincount(labels[edges > 0], minlength=count)
    unmoved = np.bincount(labels[(edges > 0) & still], minlength=count)
    return edges * (unmoved >= MIN_STILL_SHARE * total)[np.asarray(labels, np.int32)]
