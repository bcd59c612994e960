"""FLIP of two arrays, without torch: for processes that do nothing else."""

from __future__ import annotations

import multiprocessing
import os

import numpy as np

from ssa_nerfstudio.parent import end_after


def be_one_of_many() -> None:
    """In a process of `multiprocessing`: work on one core, and end with the parent, also where that has ended already.

    To be called before OpenMP is loaded, which reads its number of threads then.
    """
    os.environ["OMP_NUM_THREADS"] = "1"
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_after(parent.join)


def flip_error(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean FLIP error of LDR images [H, W, 3], float32, sRGB in [0, 1], at 67 pixels per degree.

    Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images". Unchecked: the evaluator ends the
    process on bad arguments.
    """
    import flip_evaluator

    _, mean_error, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False)
    return float(mean_error)
