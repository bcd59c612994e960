"""What only a real process shows: output that is full or closed, interruptions, full disks; never a traceback."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from experiments.benchmark.made_results import all_results, folder_of
from export.small_checkpoints import one_camera, random_gaussians, write_run
from PIL import Image

from ssa_nerfstudio.overlay.layer import OracleOverlay

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
        done = subprocess.run([*SSA, *words], stdout=full, stderr=subprocess.PIPE, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 2, done.stderr
    assert "No space left on device" in in_one_line(done.stderr)


def test_an_output_that_nobody_reads(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    words = ["bench", "smoke", "--output", "out", "--list"]
    done = subprocess.run([*SSA, *words], stdout=writer, stderr=subprocess.PIPE, text=True, cwd=tmp_path, timeout=300)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_no_output_at_all(tmp_path):
    command = 'exec "$0" -m ssa_nerfstudio bench nothing --output out >&-'
    done = subprocess.run(["bash", "-c", command, sys.executable], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert "benchmarks has no 'nothing'" in in_one_line(done.stderr)


@pytest.mark.parametrize(
    ("number", "library"),
    [
        (signal.SIGINT, "tyro"),
        (signal.SIGTERM, "numpy"),
        (signal.SIGINT, "cv2.version"),
        (signal.SIGTERM, "torch"),
        (signal.SIGINT, "scipy"),
    ],
)
def test_a_signal_while_modules_are_imported(number, library, tiny_scene, tmp_path):
    """Sent by the process itself where the import begins: the time until then differs between machines.

    OpenCV's C code drops an exception that is raised inside of it.
    """
    program = f"""
import os, sys

def interrupt(event, arguments):
    if event == "import" and arguments[0] == "{library}" and not interrupted:
        interrupted.append(True)
        os.kill(os.getpid(), {int(number)})

interrupted = []
sys.addaudithook(interrupt)
from ssa_nerfstudio.cli import main
main(sys.argv[1:])
"""
    words = [sys.executable, "-c", program, "detect", "--data", tiny_scene, "--output", tmp_path / "out"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (128 + number, "ssa detect was stopped\n")
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


@pytest.mark.parametrize(
    ("words", "names"),
    [
        pytest.param(
            "export-overlay --load-config run/config.yml --output out --apply scene/images",
            "out",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "export-splats --load-config run/config.yml --output-dir out", "out/splat.ply", marks=pytest.mark.slow
        ),
        pytest.param(
            "export-dataset --load-config run/config.yml --data scene --for colmap --output out",
            "out",
            marks=pytest.mark.slow,
        ),
        ("simulate --data scene --effects dashboard --output out", "out"),
    ],
)
def test_what_is_exported_to_a_full_disk(words, names, tiny_scene, tmp_path):
    shutil.copytree(tiny_scene, tmp_path / "scene")
    transmittance = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))
    artifact = one_camera(OracleOverlay(transmittance, torch.zeros(48, 64, 3)))
    write_run(tmp_path / "run", artifact, random_gaussians(40))
    command = f'ulimit -f 1; exec "$0" -m ssa_nerfstudio {words}'
    done = subprocess.run(["bash", "-c", command, sys.executable], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert f"error: {names} cannot be written (" in done.stderr  # OpenCV's libpng may say so before
    assert "Traceback" not in done.stderr
    left = [path for path in tmp_path.rglob("*") if path.relative_to(tmp_path).parts[0] not in ("scene", "run")]
    assert left == [tmp_path / "out"] * ("/" in names)


@pytest.mark.parametrize("words", ["--help", "detect --help", "--version"])
def test_help_that_nobody_can_see(words, tmp_path):
    command = f'exec "$0" -m ssa_nerfstudio {words} >&-'
    done = subprocess.run(["bash", "-c", command, sys.executable], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("streams", [">&-", "<&- >&- 2>&-"])
def test_a_command_that_can_say_nothing_does_its_work(streams, tiny_scene, tmp_path):
    command = f'exec "$0" -m ssa_nerfstudio detect --data "$1" --output out {streams}'
    words = ["bash", "-c", command, sys.executable, tiny_scene]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, env=ENVIRONMENT)
    assert (done.returncode, done.stderr) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_simulation_that_is_terminated_leaves_nothing(number, tmp_path):
    effects = ["watermark", "ui", "dashboard", "rain", "mud", "finger", "vignette", "dust"]
    words = ["simulate", "--threads", "1", "--output", "out", "--effects", *effects]
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    running = subprocess.Popen(
        [*SSA, *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**ENVIRONMENT, "TMPDIR": str(scratch)},
    )
    while running.poll() is None and not list(tmp_path.glob(".out.*")):
        time.sleep(0.01)
    running.send_signal(number)
    _, err = running.communicate(timeout=60)
    assert (running.returncode, err) == (128 + number, "ssa simulate was stopped\n")
    assert list(tmp_path.rglob("*")) == [scratch]


def is_colmap_of(parent: subprocess.Popen, process: Path) -> bool:
    """Whether a folder of /proc is that of a parent's structure from motion."""
    try:
        fields = (process / "stat").read_text().rpartition(")")[2].split()
        return int(fields[1]) == parent.pid and b"ssa_nerfstudio.sfm.colmap" in (process / "cmdline").read_bytes()
    except OSError:  # it has ended
        return False


def test_structure_from_motion_ends_with_a_command_that_is_terminated(tmp_path):
    """COLMAP works in a process of its own; what is done is kept for the same command.

    A signal that comes while the process is being started leaves it to end by itself, once its imports are done and it
    finds that its parent has gone.
    """
    photos = tmp_path / "photos"
    photos.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (8, 300, 400, 3), dtype=np.uint8)
    for number, photo in enumerate(noise):
        Image.fromarray(photo).save(photos / f"{number}.png")
    words = [*SSA, "process", "--train", "photos", "--output", "out", "--threads", "1"]
    running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    started = []
    while running.poll() is None and not started:
        time.sleep(0.01)
        started = [path for path in Path("/proc").glob("[0-9]*") if is_colmap_of(running, path)]
    running.terminate()
    _, err = running.communicate(timeout=60)
    assert (running.returncode, err) == (143, "stopped; the same command continues from .out.work\n")
    ends_by = time.monotonic() + 60
    while started[0].exists() and time.monotonic() < ends_by:
        time.sleep(0.01)
    assert not started[0].exists()
    assert {path.name for path in tmp_path.iterdir()} == {"photos", ".out.work"}


def test_a_report_on_a_full_disk(tmp_path):
    """Of the files of a report, those that are there are whole."""
    runs = [each for each in all_results() if each.run.scene == "attic" and each.run.seed == 0]
    folder_of(tmp_path / "results", runs)
    command = 'ulimit -f 1; exec "$0" -m ssa_nerfstudio report results --output out'
    done = subprocess.run(["bash", "-c", command, sys.executable], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert "out/report.md cannot be written" in in_one_line(done.stderr)
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("stream", ["2>/dev/full", "2>&-"])
def test_errors_that_nobody_can_read(stream, tmp_path):
    command = f'exec "$0" -m ssa_nerfstudio bench nothing --output out {stream}'
    done = subprocess.run(["bash", "-c", command, sys.executable], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")


def test_a_result_that_nobody_reads(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    config = write_run(tmp_path / "run", None)
    words = ["export-splats", "--load-config", config, "--output-dir", tmp_path / "out"]
    done = subprocess.run([*SSA, *words], stdout=writer, stderr=subprocess.PIPE, text=True, timeout=300)
    os.close(writer)
    assert (done.returncode, "Traceback" in done.stderr) == (141, False)
    assert (tmp_path / "out/splat.ply").is_file()


@pytest.mark.parametrize(
    ("before", "says"),
    [
        ("mkdir x; cd x; rmdir ../x", "the working directory cannot be used (No such file or directory)"),
        (f"for n in {{1..20}}; do mkdir {'d' * 250}; cd {'d' * 250}; done", "cannot be used (File name too long)"),
        ("ulimit -v 1500000", "free memory"),
    ],
    ids=[
        "a working directory that was deleted",
        "a working directory beyond the longest path",
        "too little memory for its libraries",
    ],
)
def test_what_a_command_is_started_in(before, says, tiny_scene, tmp_path):
    command = f'{before}; exec "$0" -m ssa_nerfstudio detect --data "$1"'
    words = ["bash", "-c", command, sys.executable, tiny_scene]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert says in in_one_line(done.stderr)


def without_privileges() -> list[str]:
    """What precedes a command that files' permissions hold for: root's privileges pass over them."""
    if os.geteuid():
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("root without setpriv may read every file")
    rights = "-dac_override,-dac_read_search"
    return ["setpriv", "--bounding-set", rights, "--inh-caps", rights]


@pytest.mark.parametrize(
    ("closed", "words", "says"),
    [
        ("scene/images", "detect --data scene --output out", "scene/images/test_0000.png: Permission denied"),
        ("scene/transforms.json", "detect --data scene --output out", "transforms.json cannot be read (Permission"),
        ("scene/images/train_0003.png", "detect --data scene --output out", "train_0003.png cannot be read"),
        ("run/nerfstudio_models", "export-splats --load-config run/config.yml --output-dir out", "run/nerfstudio_mod"),
        pytest.param(
            "run",
            "export-splats --load-config run/config.yml --output-dir out",
            "run/config.yml: Permission denied",
            marks=pytest.mark.slow,
        ),
        ("here", "detect --data scene --output here/out", "here/out"),
    ],
)
def test_what_may_not_be_read_or_written(closed, words, says, tiny_scene, tmp_path):
    shutil.copytree(tiny_scene, tmp_path / "scene")
    write_run(tmp_path / "run", None)
    (tmp_path / "here").mkdir()
    (tmp_path / closed).chmod(0)
    command = [*without_privileges(), *SSA, *words.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    (tmp_path / closed).chmod(0o700)
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("ssa-nerfstudio: error: ")]
    assert says in line
    assert "Permission denied" in line
    assert not (tmp_path / "out").exists()


def test_a_name_that_is_no_text(tmp_path):
    folder = os.fsencode(tmp_path) + b"/\xff\xfe"
    os.mkdir(folder)
    done = subprocess.run([*SSA, "detect", "--data", folder], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert "holds no photo" in in_one_line(done.stderr)


@pytest.mark.parametrize("words", [["run", "photos", "--output", "out"], ["demo", "--output", "out"]])
def test_loading_nerfstudio_is_not_waited_for(words, tmp_path):
    """It takes seconds, and as long as a minute on a busy machine."""
    stub = tmp_path / "stubs" / "nerfstudio"
    stub.mkdir(parents=True)
    (stub / "__init__.py").write_text("import time; print('importing', flush=True); time.sleep(300)")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(stub.parent), *sys.path])}
    running = subprocess.Popen(
        [*SSA, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment
    )
    assert running.stdout is not None
    assert [running.stdout.readline() for _ in range(2)] == ["Loading nerfstudio ...\n", "importing\n"]
    running.terminate()
    _, err = running.communicate(timeout=60)
    assert (running.returncode, err) == (143, f"ssa {words[0]} was stopped\n")
    assert [path.name for path in tmp_path.iterdir()] == ["stubs"]
