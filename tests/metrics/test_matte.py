"""Matte metrics against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssa_nerfstudio.metrics.matte import layer_errors, matte_error, matte_iou


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


def flat(value: float | tuple[float, ...], height: int = 20, width: int = 30) -> np.ndarray:
    return np.broadcast_to(np.asarray(value, np.float32), (height, width, 3)).copy()


def test_the_true_layers_score_best_and_none_scores_what_they_hide() -> None:
    transmitted, added = flat(1.0), flat(0.0)
    transmitted[10:], added[10:] = 0.2, (0.4, 0.2, 0.8)
    right = layer_errors(transmitted[..., :1], added, transmitted, added)
    assert right["matte_iou"] == 1
    assert max(right["matte_error"], right["premultiplied_error"], right["transmittance_error"]) < 1e-6
    empty = layer_errors(flat(1.0)[..., :1], flat(0.0), transmitted, added)
    assert empty["matte_iou"] == 0
    assert empty["matte_error"] == pytest.approx(0.4, abs=1e-6)
    assert empty["premultiplied_error"] == pytest.approx(0.7 / 3, abs=1e-6)


def test_the_matte_of_added_light_is_the_least_opacity_that_explains_it() -> None:
    added, hidden = flat(0.0), flat(1.0)[..., :1]
    added[:, :15, 1] = 0.6
    hidden[:, :15] = 0.4
    scores = layer_errors(hidden, added, flat(1.0), added)
    assert scores["matte_error"] == pytest.approx(0, abs=1e-6)
    assert scores["premultiplied_error"] == 0
    assert scores["transmittance_error"] == pytest.approx(0.3, abs=1e-6)


def test_a_truth_of_another_size_is_averaged() -> None:
    transmitted, added = flat(0.5, 40, 60), flat((0.1, 0.2, 0.3), 40, 60)
    transmitted[::2] = 0.7
    scores = layer_errors(flat(0.6)[..., :1], flat((0.1, 0.2, 0.3)), transmitted, added)
    assert scores["transmittance_error"] < 1e-6
    assert scores["premultiplied_error"] < 1e-6


@pytest.mark.parametrize("factor", [2, 4, 5])
def test_no_pixel_of_a_larger_truth_is_skipped(factor: int) -> None:
    transmitted, added = flat(1.0, 20 * factor, 30 * factor), flat(0.0, 20 * factor, 30 * factor)
    transmitted[::factor, ::factor], added[::factor, ::factor] = 0.0, 1.0  # one pixel of a block
    share = 1 / factor**2
    scores = layer_errors(flat(1.0 - share)[..., :1], flat(share), transmitted, added)
    assert max(scores[name] for name in ("matte_error", "premultiplied_error", "transmittance_error")) < 1e-6


def test_a_pixel_is_artifact_from_half_its_light_on() -> None:
    """Of four parts of the frame, the truth hides 0.9, 0.3, 0.7 and 0.2 and the learned matte 0.8, 0.3, 0.4, 0.6."""
    true, learned = flat(1.0, 8, 8), flat(1.0, 8, 8)
    for k, (truth, found) in enumerate(((0.9, 0.8), (0.3, 0.3), (0.7, 0.4), (0.2, 0.6))):
        true[2 * k : 2 * k + 2], learned[2 * k : 2 * k + 2] = 1 - truth, 1 - found
    black = flat(0.0, 8, 8)
    assert layer_errors(learned[..., :1], black, true, black)["matte_iou"] == pytest.approx(1 / 3)
