"""Matte metrics against values worked out by hand."""

from __future__ import annotations

import pytest
import torch

from ssa_nerfstudio.metrics.matte import matte_error, matte_iou


def test_matte_iou_by_hand() -> None:
    alpha = torch.tensor([[0.9, 0.6, 0.5], [0.1, 0.0, 1.0]])
    mask = torch.tensor([[True, False, True], [False, False, True]])
    assert matte_iou(alpha, mask) == 2 / 4
    assert matte_iou(alpha, mask, threshold=0.4) == 3 / 4
    assert matte_iou(torch.zeros(2, 3), mask) == 0.0
    assert matte_iou(torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.bool)) == 1.0


def test_matte_iou_refuses_bad_input() -> None:
    alpha, mask = torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.bool)
    with pytest.raises(ValueError, match="mask must be bool"):
        matte_iou(alpha, mask.float())
    with pytest.raises(ValueError, match="mask must be bool"):
        matte_iou(alpha, mask.T)
    with pytest.raises(ValueError, match="threshold"):
        matte_iou(alpha, mask, threshold=1.0)
    with pytest.raises(ValueError, match=r"alpha must be a non-empty \[H, W\]"):
        matte_iou(alpha[..., None], mask)


def test_matte_error_by_hand() -> None:
    alpha, target = torch.tensor([[0.0, 1.0]]), torch.tensor([[0.25, 0.25]])
    assert matte_error(alpha, target) == 0.5
    assert matte_error(alpha, alpha) == 0.0
    with pytest.raises(ValueError, match="differ in shape"):
        matte_error(alpha, target.T)
    with pytest.raises(ValueError, match="target holds NaN"):
        matte_error(alpha, target * torch.nan)
