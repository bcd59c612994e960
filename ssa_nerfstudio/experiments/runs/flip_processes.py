"""FLIP of many views at a time: it holds Python's lock, scales badly with threads, and a GPU is done long before."""

from __future__ import annotations

from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context

from torch import Tensor

from ssa_nerfstudio._system.process_lifetime import become_worker
from ssa_nerfstudio.metrics import image as metrics
from ssa_nerfstudio.metrics.flip import flip_error


class FlipProcesses:
    """So many processes, that start with the first view."""

    def __init__(self, processes: int) -> None:
        """Make none yet; 1: the views are compared in this process, one at a time."""
        self._pool = None
        if processes > 1:
            # Started anew: a fork would take CUDA's state along.
            self._pool = ProcessPoolExecutor(processes, get_context("spawn"), initializer=become_worker)

    def submit(self, render: Tensor, target: Tensor) -> Future[float]:
        """`metrics.flip` of a view, when it is done.

        Raises:
            ValueError: as there, at once.
        """
        if self._pool is not None:
            return self._pool.submit(flip_error, *metrics.flip_arrays(render, target))
        done: Future[float] = Future()
        done.set_result(metrics.flip(render, target))
        return done

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
