"""Shifted captures, and the confidence interval of the false-alarm rate."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssa_nerfstudio.evidence.edge_evidence import measure_edges
from ssa_nerfstudio.evidence.null_distribution import clopper_pearson, null_shares
from ssa_nerfstudio.evidence.statistics import accumulate


def test_the_interval_is_clopper_pearsons():
    """0 of 200: 1 - 0.025 ** (1 / 200); 200 of 200 mirrored; in between against tabulated values."""
    assert clopper_pearson(0, 200) == pytest.approx((0.0, 1 - 0.025 ** (1 / 200)))
    assert clopper_pearson(200, 200) == pytest.approx((0.025 ** (1 / 200), 1.0))
    assert clopper_pearson(5, 20) == pytest.approx((0.0866, 0.4910), abs=1e-4)


def test_shifts_reach_beyond_the_edges_of_what_is_soft():
    """A ramp of 20 pixels is static in all views: shifted by a few pixels its edges still lie over each other."""
    rng = np.random.default_rng(0)
    ramp = np.clip((np.abs(np.arange(128) - 64) - 15) / 20, 0, 1)[None, :, None]
    photos = [255 * ramp * (0.5 + 0.5 * rng.random((96, 128, 3))) for _ in range(24)]
    views = [(torch.from_numpy(photo.round().astype(np.uint8)), None) for photo in photos]
    evidence = measure_edges(accumulate(views))
    assert min(evidence.shares) > 0.1
    drawn = np.array([*null_shares(evidence, 10, np.random.default_rng(0))])
    assert (drawn.mean(axis=0) < 0.05 * np.array(evidence.shares)).all()
    assert len(np.unique(drawn[:, 1])) > 1, "draws are different captures"
