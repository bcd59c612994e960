"""Hysteresis of static edges. Evidence itself is tested with detection."""

from __future__ import annotations

import numpy as np

from ssa_nerfstudio.evidence.edge_evidence import _mostly_still


def test_connected_edges_are_kept_if_a_tenth_of_them_is_still():
    edges = np.zeros((9, 40), np.uint8)
    edges[2, 2:22] = edges[6, 2:22] = 1
    still = np.zeros((9, 40), bool)
    still[2, 20:22] = still[6, 21] = True
    kept = _mostly_still(edges, still)
    assert (kept[2] == edges[2]).all()
    assert not kept[6].any()
