"""The confidence interval of the false-alarm rate."""

from __future__ import annotations

import pytest

from ssa_nerfstudio.evidence.null_distribution import clopper_pearson


def test_the_interval_is_clopper_pearsons():
    """0 of 200: 1 - 0.025 ** (1 / 200); 200 of 200 mirrored; in between against tabulated values."""
    assert clopper_pearson(0, 200) == pytest.approx((0.0, 1 - 0.025 ** (1 / 200)))
    assert clopper_pearson(200, 200) == pytest.approx((0.025 ** (1 / 200), 1.0))
    assert clopper_pearson(5, 20) == pytest.approx((0.0866, 0.4910), abs=1e-4)
