"""What records programs where there is no CUDA."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import CapturedPrograms, Program, Record

CUDA = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"))


def run_again() -> Record:
    """Repeats a program by running it again, and copies its results to where the first ones are."""

    def record(program: Program) -> tuple[list[Tensor], Callable[[], None]]:
        results = program()

        def repeat() -> None:
            for old, new in zip(results, program(), strict=True):
                old.data.copy_(new)

        return results, repeat

    return record


def recorder(device: str) -> Callable[[], Record]:
    """What makes records on a device."""
    return CapturedPrograms if device == "cuda" else run_again
