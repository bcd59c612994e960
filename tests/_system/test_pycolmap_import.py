"""pycolmap in the process of a command."""

from __future__ import annotations

import signal
import subprocess
import sys

ENDED = """
import os, signal
from ssa_nerfstudio._system.pycolmap_import import import_pycolmap
assert import_pycolmap().Reconstruction().num_images() == 0
os.kill(os.getpid(), signal.SIGTERM)
"""


def test_sigterm_still_ends_the_process_without_a_word():
    done = subprocess.run([sys.executable, "-c", ENDED], capture_output=True, text=True, timeout=300)
    assert done.returncode == -signal.SIGTERM
    assert done.stderr == ""
