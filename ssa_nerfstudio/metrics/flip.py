"""FLIP of two arrays, without torch: for processes that do nothing else."""

from __future__ import annotations

import numpy as np


def flip_error(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean FLIP error of LDR images [H, W, 3], float32, sRGB in [0, 1], at 67 pixels per degree.

    Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images". Unchecked: the evaluator ends the
    process on bad arguments.
    """
    import flip_evaluator

    _, mean_error, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False)
    return float(mean_error)
