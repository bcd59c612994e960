"""FLIP of two arrays, without torch: for child processes that compute nothing else."""

from __future__ import annotations

import numpy as np


def flip_error(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean FLIP error at 67 pixels per degree.

    Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images".

    Args:
        reference, test: LDR images [H, W, 3], float32, sRGB in [0, 1]. They are not checked here, and the evaluator
            ends the process on bad arguments: `image.flip` and `image.flip_arrays` check.

    Returns:
        A number in [0, 1].
    """
    import flip_evaluator

    _, mean_error, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False)
    return float(mean_error)
