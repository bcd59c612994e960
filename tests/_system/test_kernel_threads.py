"""The pool of threads that the kernels run on."""

from __future__ import annotations

import os
import signal

import pytest
import torch
from rasterization_scenes import torch_threads

from ssa_nerfstudio._system.kernel_threads import on_all_threads


@pytest.mark.parametrize("threads", [1, 2, 3, 9])
def test_a_kernel_runs_once_for_each_of_torchs_threads_and_all_are_done_on_return(threads: int) -> None:
    runs: list[tuple[int, int]] = []
    with torch_threads(threads):
        on_all_threads(lambda thread, count, target: target.append((thread, count)), runs)
    assert sorted(runs) == [(thread, threads) for thread in range(threads)]


@pytest.mark.parametrize("failing", [0, 1, 2])
def test_an_error_on_any_thread_reaches_the_caller(failing: int) -> None:
    def kernel(thread: int, threads: int) -> None:
        if thread == failing:
            raise ArithmeticError(f"thread {thread} of {threads}")

    with torch_threads(3), pytest.raises(ArithmeticError, match=f"thread {failing} of 3"):
        on_all_threads(kernel)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_child_starts_threads_of_its_own() -> None:
    with torch_threads(2):
        on_all_threads(lambda thread, threads: None)
        child = os.fork()
        if child == 0:
            signal.alarm(30)  # a child that waits for its parent's threads would wait for ever
            runs: list[int] = []
            try:
                torch.set_num_threads(2)
                on_all_threads(lambda thread, threads: runs.append(thread))
            finally:
                os._exit(0 if sorted(runs) == [0, 1] else 1)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
