"""The null distribution of static edges: the capture itself with its blocks of views shifted at random.

Shifts by a few pixels keep chance alignments and the regularities of a capture (a horizon at one height, a centered
object, vignetting) and destroy only alignment to the pixel. docs/detect.md derives it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.special import betaincinv
from torch import Tensor

from ssa_nerfstudio.evidence.edge_evidence import COARSE_FACTOR, EdgeEvidence, edge_shares, evidence_field

SIGNIFICANCE = 0.01
"""Largest probability by chance of what is reported: an artifact, an outline, a falloff, a change over time or with the
scene's light."""
MAX_SHIFT = 16
"""Blocks are shifted by up to this many working pixels in each direction, in steps of COARSE_FACTOR."""
VALUES_AT_ONCE = 2**22
"""Sums of moments, of shifted captures or intervals, that are computed together: a GPU waits for each launch."""


def null_shares(evidence: EdgeEvidence, draws: int, rng: np.random.Generator) -> Iterator[tuple[float, float]]:
    """Draw shares of static edges after every block was shifted at random, by the same way at both scales.

    Moving edges are left out where the capture itself has them. That removes more of the capture's edges than of a
    shifted one's: p-values err upwards.

    Args:
        evidence: of the capture.
        draws: how many shifted captures.
        rng: of the shifts.

    Yields:
        `edge_shares` of a shifted capture.
    """
    moments = evidence.moments
    reach = MAX_SHIFT // COARSE_FACTOR
    steps = COARSE_FACTOR, 1
    padded_moments = [_wrap_pad(at_scale, reach * step) for at_scale, step in zip(moments, steps, strict=True)]
    at_once = max(1, VALUES_AT_ONCE // moments[0][0].numel())
    for first in range(0, draws, at_once):
        count = min(at_once, draws - first)
        shifts = rng.integers(0, 2 * reach + 1, (count, len(moments[0]), 2)).tolist()
        fields = []
        for at_scale, padded, step in zip(moments, padded_moments, steps, strict=True):
            h, w = at_scale.shape[2:]
            sums = at_scale.new_zeros(3, count, h, w)
            for draw, of_blocks in enumerate(shifts):
                own = sums[:, draw]
                for block, (y, x) in zip(padded, of_blocks, strict=True):
                    own += block[:, y * step : y * step + h, x * step : x * step + w]
            fields.append(evidence_field(sums, len(at_scale)))
        yield from edge_shares(fields, evidence.still)


def clopper_pearson(successes: int, trials: int) -> tuple[float, float]:
    """95 % confidence interval of a binomial rate (Clopper and Pearson 1934)."""
    low = 0.0 if successes == 0 else float(betaincinv(successes, trials - successes + 1, 0.025))
    high = 1.0 if successes == trials else float(betaincinv(successes + 1, trials - successes, 0.975))
    return low, high


def _wrap_pad(moments: Tensor, margin: int) -> Tensor:
    """Pad on all sides as if the frame were a torus, however small it is."""
    h, w = moments.shape[2:]
    rows = torch.arange(-margin, h + margin, device=moments.device) % h
    columns = torch.arange(-margin, w + margin, device=moments.device) % w
    return moments[:, :, rows][:, :, :, columns]
