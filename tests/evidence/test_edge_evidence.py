"""Evidence of static edges at a pixel, and their hysteresis. What follows from it is tested with detection."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssa_nerfstudio.evidence.edge_evidence import EdgeEvidence, _mostly_still, evidence_field


def test_connected_edges_are_kept_if_a_tenth_of_them_is_still():
    edges = np.zeros((9, 40), np.uint8)
    edges[2, 2:22] = edges[6, 2:22] = 1
    still = np.zeros((9, 40), bool)
    still[2, 20:22] = still[6, 21] = True
    kept = _mostly_still(edges, still)
    assert (kept[2] == edges[2]).all()
    assert not kept[6].any()


def test_weaker_edges_that_do_not_move_belong_to_an_outline():
    """Rows: an edge that fades, one that fades and moves, and one below three standard errors."""
    field = torch.zeros(13, 40)
    field[2, 2:12], field[2, 12:30] = 8.0, 4.0
    field[6, 2:12], field[6, 12:30] = 8.0, 4.0
    field[10, 2:30] = 2.9
    still = torch.ones(13, 40, dtype=torch.bool)
    still[6, 12:] = False
    edges = EdgeEvidence([], [still, still[::4, ::4]], [field, field[::4, ::4]])
    outlines = edges.outlines
    assert outlines[2, 2:30].all()
    assert outlines[6, 2:12].all()
    assert not outlines[6, 13:].any()
    assert not outlines[10].any()
    assert (edges.mask == (field >= 6).numpy()).all()


def test_evidence_is_the_mean_gradient_over_its_standard_error():
    """Three blocks whose gradients are 3, 4 and 5 tenths along x and 0, 1 and 2 tenths along y."""
    x, y = torch.tensor([0.3, 0.4, 0.5]), torch.tensor([0.0, 0.1, 0.2])
    sums = torch.stack([x.sum(), y.sum(), (x**2 + y**2).sum()]).reshape(3, 1, 1)
    error = float(x.var(correction=0) + y.var(correction=0)) / 2 + (1 / 255 / 6) ** 2
    assert evidence_field(sums, 3).item() == pytest.approx((0.4**2 + 0.1**2) ** 0.5 / error**0.5, rel=1e-4)
