"""`python -m ssa_nerfstudio` from a clone that is only on the path."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import read_benchmark
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan

CLONE = Path(__file__).parents[2]


def test_bench_from_another_folder(tmp_path):
    # -S leaves out the .pth file by which an editable install is found, and the packages, which the path gets back.
    path = os.pathsep.join([str(CLONE), sysconfig.get_path("purelib")])
    done = subprocess.run(
        [sys.executable, "-S", "-m", "ssa_nerfstudio", "bench", "smoke", "--output", "results", "--list"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[2::3] == [run.id for run in plan(read_benchmark("smoke"))]
