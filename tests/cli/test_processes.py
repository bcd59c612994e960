"""What only a real process shows: output that is full or closed, interruptions, full disks; never a traceback."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SSA = (sys.executable, "-m", "ssa_nerfstudio")
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


def in_one_line(err: str) -> str:
    """The only line of an error stream."""
    (line,) = err.splitlines()
    assert line.startswith("ssa-nerfstudio: error: ")
    return line


@pytest.mark.parametrize("words", [["--help"], ["bench", "smoke", "--output", "out", "--list"]])
def test_an_output_that_is_full(words, tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*SSA, *words], stdout=full, stderr=subprocess.PIPE, text=True, cwd=tmp_path, timeout=60)
    assert done.returncode == 2, done.stderr
    assert "No space left on device" in in_one_line(done.stderr)


def test_an_output_that_nobody_reads(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    words = ["bench", "smoke", "--output", "out", "--list"]
    done = subprocess.run([*SSA, *words], stdout=writer, stderr=subprocess.PIPE, text=True, cwd=tmp_path, timeout=60)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_no_output_at_all(tmp_path):
    command = 'exec "$0" -m ssa_nerfstudio bench nothing --output out >&-'
    done = subprocess.run(["bash", "-c", command, sys.executable], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert "benchmarks has no 'nothing'" in in_one_line(done.stderr)


@pytest.mark.parametrize("seconds", [0.15, 0.3, 0.6, 1.2])
def test_ctrl_c_while_modules_are_imported(seconds, tiny_scene, tmp_path):
    words = ["detect", "--data", tiny_scene, "--output", tmp_path / "out"]
    running = subprocess.Popen([*SSA, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(seconds)
    running.send_signal(signal.SIGINT)
    _, err = running.communicate(timeout=60)
    assert err == "ssa detect was stopped\n"
    # Python may end itself by the signal where the import system was interrupted; shells call both 130.
    assert running.returncode in (130, -signal.SIGINT)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("blocks", [0, 1])
def test_a_full_disk(blocks, tiny_scene, tmp_path):
    """Files may not grow beyond a limit, as on a full disk; nothing half-written is left."""
    shutil.copytree(tiny_scene, tmp_path / "scene")
    words = "detect --data scene --threads 1 --output out"
    command = f'ulimit -f {blocks}; exec "$0" -m ssa_nerfstudio {words}'
    done = subprocess.run(["bash", "-c", command, sys.executable], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert ("out cannot be written" if blocks else "temporary directory") in in_one_line(done.stderr)
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_a_name_that_is_no_text(tmp_path):
    folder = os.fsencode(tmp_path) + b"/\xff\xfe"
    os.mkdir(folder)
    done = subprocess.run([*SSA, "detect", "--data", folder], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert "holds no photo" in in_one_line(done.stderr)
