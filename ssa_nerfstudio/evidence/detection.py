"""Detection of a static artifact: a test on static edges, with a null distribution from the capture itself.

docs/detect.md derives it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio.evidence.edge_evidence import MIN_EDGE_SHARES, measure_edges
from ssa_nerfstudio.evidence.null_distribution import SIGNIFICANCE, clopper_pearson, null_shares
from ssa_nerfstudio.evidence.static_area import artifact_area
from ssa_nerfstudio.evidence.statistics import ImageStatistics

DRAWS = 200
"""Shifted captures in the null distribution."""
MIN_VIEWS = 6
"""With fewer views than this, standard errors mean nothing and nothing is reported."""
MIN_OPAQUE_COVERAGE = 0.25
"""Share of the artifact's area that has to be opaque for verdict opaque."""


Verdict = Literal["none", "faint", "opaque"]


@dataclass(frozen=True)
class Interval:
    """Neighboring views between which the artifact does not change."""

    first: int
    """Number of its first view, from 0, in the order of the capture."""
    end: int
    """Number of the view after its last."""
    verdict: Verdict
    coverage: float
    """As for `Detection`."""


@dataclass(frozen=True)
class Detection:
    """Result of the test for one camera."""

    verdict: Verdict
    """none; faint: the scene shows through everywhere; opaque: it is hidden somewhere."""
    coverage: float
    """Share of the frame that `mask` covers; 0 for verdict none."""
    p_value: float
    """Share of shifted captures (and this one) with at least as many static edges as this one."""
    p_interval: tuple[float, float]
    """95 % interval of the false-alarm rate (Clopper-Pearson)."""
    views: int
    """Number of views."""
    shares: tuple[float, float]
    """Share of static edges at the fine and at the coarse scale."""
    null_shares: tuple[float, float]
    """The same, mean over the shifted captures."""
    evidence: Tensor
    """[h, w] at the working resolution; 0 where the edges move."""
    mask: Tensor
    """[H, W] bool: True where the artifact is; nowhere for verdict none."""
    opaque: Tensor
    """[H, W] bool: where it hides the scene, likewise."""
    intervals: tuple[Interval, ...] = ()
    """Two or more, where the artifact changes (`interval_detection`)."""

    @property
    def nothing_moves(self) -> bool:
        """Whether all of the frame stands still: there is no scene to tell an artifact from."""
        return self.verdict != "none" and not self.intervals and bool(self.mask.all())

    @property
    def too_few_edges(self) -> bool:
        """Whether the static edges are significant, but too few to be reported."""
        return self.verdict == "none" and self.p_value <= SIGNIFICANCE


def detect(statistics: ImageStatistics, draws: int = DRAWS, seed: int = 0, known: bool = False) -> Detection:
    """Test whether the views have a static artifact.

    Args:
        statistics: of all views of one camera, in the order of the capture.
        draws: shifted captures in the null distribution.
        seed: of the shifts; global random state is neither used nor changed.
        known: whether other photos have shown that an artifact is there, so that its edges, if there are any, need
            be neither significant nor many.
    """
    views = int(statistics.views.max())
    edges = measure_edges(statistics)
    shares, evidence = edges.shares, edges.fields[0] * edges.still[0]
    nowhere = torch.zeros(statistics.size, dtype=torch.bool)
    untested = Detection("none", 0.0, 1.0, (0.0, 1.0), views, shares, (0.0, 0.0), evidence, nowhere, nowhere)
    if views < MIN_VIEWS:
        return untested
    null = list(null_shares(edges, draws, np.random.default_rng(seed)))
    exceeding = sum(_strength(draw) >= _strength(shares) for draw in null)
    p_value, p_interval = (1 + exceeding) / (1 + draws), clopper_pearson(exceeding, draws)
    fine, coarse = (float(np.mean(scale)) for scale in zip(*null, strict=True))
    tested = replace(untested, p_value=p_value, p_interval=p_interval, null_shares=(fine, coarse))
    area = artifact_area(edges, statistics)
    # What encloses as much of the frame as coarse edges have to cover may be thin.
    many = _strength((shares[0] - fine, shares[1] - coarse)) >= 1 or area.opaque_share >= MIN_EDGE_SHARES[1]
    if not (p_value <= SIGNIFICANCE and many) and not (known and edges.mask.any()):
        return tested
    coverage = float(area.mask.float().mean())
    verdict = "opaque" if area.opaque_share >= MIN_OPAQUE_COVERAGE * coverage else "faint"
    return replace(tested, verdict=verdict, coverage=coverage, mask=area.mask, opaque=area.opaque)


def _strength(shares: tuple[float, ...]) -> float:
    """Shares of static edges relative to MIN_EDGE_SHARES; the larger of the two scales."""
    return max(share / min_share for share, min_share in zip(shares, MIN_EDGE_SHARES, strict=True))
