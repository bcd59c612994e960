"""How many cores a process may use."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os
from ssa_nerfstudio._system.cores import usable_cores
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
print(usable_cores())
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs an affinity to set")
def test_only_cores_that_a_process_may_use_count():
    assert subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True).stdout == "1\n"
