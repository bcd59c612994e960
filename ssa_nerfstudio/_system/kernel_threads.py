"""Numba kernels on all cores, by a pool of Python threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch

from ssa_nerfstudio._system.cores import usable_cores

_pool: ThreadPoolExecutor | None = None


def on_all_threads(kernel: Callable, *arguments) -> None:
    """Run `kernel(t, threads, *arguments)` for every thread t of torch's number of threads; it must release the GIL.

    Not numba's `prange`: its threading layers do not all allow calls from the viewer's and the trainer's threads at
    once, and OpenMP's spinning barriers stall when other processes want the cores.
    """
    threads = torch.get_num_threads()
    jobs = [_executor().submit(kernel, t, threads, *arguments) for t in range(1, threads)]
    kernel(0, threads, *arguments)
    for job in jobs:
        job.result()


def _executor() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(max_workers=usable_cores(), thread_name_prefix="ssa-kernel")
    return _pool


def _forget_pool() -> None:
    global _pool
    _pool = None


# Threads do not survive a fork; the child starts its own.
os.register_at_fork(after_in_child=_forget_pool)
