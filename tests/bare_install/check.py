"""Use the product without its experiments, as installed by `pip install .`: `check.py CAPTURE`, run by `make bare`.

Detects, trains, exports and evaluates on a small capture, runs structure from motion on its photos, and asks for
commands whose extra is missing. Not a pytest module: the environment has no pytest.
"""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BIN = Path(sys.executable).parent
EXPERIMENTS = ("bench", "demo", "report", "simulate", "tradeoff")
MAX_STARTUP_RATIO = 3.0
"""Of `ssa --help` to `python -c pass`."""
MAX_HELP_SECONDS = 1.5


def run(*command: object, code: int = 0) -> str:
    """Run one of this environment's commands; what it printed."""
    name, *arguments = map(str, command)
    done = subprocess.run([str(BIN / name), *arguments], capture_output=True, text=True)
    assert done.returncode == code, f"{name} {arguments} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    print(f"ok: {name} {' '.join(arguments)}"[:150], flush=True)
    return done.stdout + done.stderr


def seconds(*command: str) -> float:
    """Fastest of five runs."""
    times = []
    for _ in range(5):
        start = time.perf_counter()
        subprocess.run([str(BIN / command[0]), *command[1:]], capture_output=True, check=True)
        times.append(time.perf_counter() - start)
    return min(times)


def check_environment() -> None:
    """The environment lacks at least one package of the extra, else the checks mean nothing."""
    extra = re.compile(r"extra == .experiments.")
    stated = [line for line in importlib.metadata.requires("ssa-nerfstudio") or () if extra.search(line)]
    names = [re.split(r"[<>=!~ ;\[]", line, maxsplit=1)[0] for line in stated]
    installed = {distribution.name.lower() for distribution in importlib.metadata.distributions()}
    missing = [name for name in names if name.lower() not in installed]
    assert "albumentations" in missing, f"the extra is installed: {names}"


def check_startup() -> None:
    """Help answers quickly."""
    plain, usage = seconds("python", "-c", "pass"), seconds("ssa", "--help")
    assert usage < MAX_STARTUP_RATIO * plain, f"ssa --help takes {usage:.3f} s, python -c pass {plain:.3f} s"
    for command in ("run", "detect", "process", "export-dataset", "export-overlay", "export-splats", *EXPERIMENTS):
        taken = seconds("ssa", command, "--help")
        assert taken < MAX_HELP_SECONDS, f"ssa {command} --help takes {taken:.2f} s"
    loaded = run("python", "-c", "import sys, ssa_nerfstudio; print('torch' in sys.modules)")
    assert loaded.strip() == "False"


def check_product(capture: Path, scratch: Path) -> None:
    """From photos to splats and to the artifact as a picture."""
    assert "opaque" in run("ssa", "detect", "--data", capture, "--output", scratch / "detected")
    small = ("--pipeline.model.num-downscales", "0", "--max-num-iterations", "20", "--vis", "tensorboard")
    run("ns-train", "ssa-splatfacto", "--data", capture, "--output-dir", scratch / "runs", *small)
    (config,) = (scratch / "runs").rglob("config.yml")
    run("ssa", "export-splats", "--load-config", config, "--output-dir", scratch / "splats", "--compressed")
    run("ns-export", "gaussian-splat", "--load-config", config, "--output-dir", scratch / "same")
    assert (scratch / "splats/splat.ply").read_bytes() == (scratch / "same/splat.ply").read_bytes()
    run(
        "ssa",
        "export-overlay",
        "--load-config",
        config,
        "--output",
        scratch / "artifact",
        "--apply",
        capture / "images",
    )
    assert (scratch / "artifact/overlay.png").is_file()
    run("ns-eval", "--load-config", config, "--output-path", scratch / "metrics.json")
    out = scratch / "out"
    run("ssa", "run", capture, "--output", out, "--steps", "20", "--train.pipeline.model.num-downscales", "0")
    assert (out / "report.html").is_file()
    run("ssa", "export-dataset", "--for", "colmap", "--load-config", config, "--output", scratch / "masked")
    refused = run("ssa", "process", "--train", capture / "images", "--output", scratch / "processed", code=2)
    assert "could be registered" in refused, "twelve views of 160 pixels are too few for structure from motion"


def check_missing_extra(capture: Path, scratch: Path) -> None:
    """A command that needs a package of the extra names the extra in one line.

    nerfstudio brings matplotlib, psutil and others along, so that `ssa demo` and `ssa report` work without it, too.
    """
    for command in (("bench", "smoke"), ("tradeoff", "smoke"), ("simulate", "--data", capture, "--effects", "mud")):
        told = run("ssa", *command, "--output", scratch / f"{command[0]}-output", code=2).strip()
        assert "pip install 'ssa-nerfstudio[experiments]'" in told, told
        assert len(told.splitlines()) == 1, told


if __name__ == "__main__":
    check_environment()
    check_startup()
    with tempfile.TemporaryDirectory() as folder:
        check_product(Path(sys.argv[1]), Path(folder))
        check_missing_extra(Path(sys.argv[1]), Path(folder))
    print("the product stands without its experiments")
