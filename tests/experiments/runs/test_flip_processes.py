"""FLIP in processes of its own: the same numbers, early refusals, and nobody left behind."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import psutil
import pytest
import torch

from ssa_nerfstudio._system.process_lifetime import become_worker
from ssa_nerfstudio.experiments.runs.flip_processes import FlipProcesses
from ssa_nerfstudio.metrics import image as metrics
from ssa_nerfstudio.metrics.flip import flip_error

PROGRAM = """
import sys, time, torch
from ssa_nerfstudio.experiments.runs.flip_processes import FlipProcesses

if __name__ == "__main__":
    flips = FlipProcesses(2)
    image = torch.rand(16, 16, 3)
    flip = flips.submit(image, 1 - image)
    print(flip.result() > 0 if sys.argv[1] == "at work" else True, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("processes", [1, 2])
def test_views_get_their_own_number_in_whatever_order_they_end(processes):
    views = torch.rand(5, 40, 30, 3, generator=torch.Generator().manual_seed(0))
    flips = FlipProcesses(processes)
    try:
        waiting = [flips.submit(view, views[0]) for view in views]
        assert [flip.result() for flip in waiting] == [metrics.flip(view, views[0]) for view in views]
        with pytest.raises(ValueError, match="differ in shape"):
            flips.submit(views[0], views[0][:20])
    finally:
        flips.close()
    assert not multiprocessing.active_children()


def test_each_works_on_one_core(monkeypatch):
    """numpy's BLAS and OpenMP read how many there are when they are loaded."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    with ProcessPoolExecutor(1, get_context("spawn"), become_worker) as pool:
        pools = pool.submit(threads).result()
    assert pools
    assert set(pools.values()) == {1}


def threads() -> dict[str, int]:
    """Of every pool that there is once FLIP is loaded."""
    from threadpoolctl import threadpool_info

    flip_error(np.zeros((8, 8, 3), np.float32), np.ones((8, 8, 3), np.float32))
    return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}


@pytest.mark.parametrize("when", ["at work", "as they start"])
def test_processes_end_with_one_that_is_killed(tmp_path, when):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    parent = subprocess.Popen([sys.executable, program, when], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    assert parent.stdout.readline().strip() == "True"
    children = psutil.Process(parent.pid).children(recursive=True)
    assert children
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 240  # they end once they have started, which takes long on a busy machine
    while any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in children):
        assert time.monotonic() < deadline, "processes go on without their parent"
        time.sleep(0.1)
