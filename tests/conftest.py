"""What the tests share: where real captures are, and a tiny scene with a dashboard in front of it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch

from ssa_nerfstudio.experiments.effects.dashboard import Dashboard
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def captures() -> Path:
    """The folder of real captures: $SSA_DATA, or data/ in the working directory."""
    folder = Path(os.environ.get("SSA_DATA", "data"))
    if not (folder / "fox" / "transforms.json").exists():
        pytest.skip(f"no real captures in {folder}; set SSA_DATA to the folder that holds fox, plush, ...")
    return folder


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 12 training views of 64 x 48 pixels behind a dashboard, and 3 clean test views. Read only."""
    scene = DemoScene(views=12, test_views=3, width=64, height=48)
    folder = tmp_path_factory.mktemp("scene") / "dashboard"
    scene.write(folder, Dashboard().layers(scene.height, scene.width, np.random.default_rng(0)))
    return folder


@pytest.fixture
def broken_scene(tiny_scene: Path, tmp_path: Path) -> Path:
    """A copy of the tiny scene for a test to break."""
    return Path(shutil.copytree(tiny_scene, tmp_path / "scene"))


@pytest.fixture(autouse=True)
def no_event_writers_left():
    """nerfstudio keeps event writers in a global: one test's would go on writing into its folder in the next."""
    yield
    if "nerfstudio.utils.writer" in sys.modules:
        sys.modules["nerfstudio.utils.writer"].EVENT_WRITERS.clear()


def edit_transforms(scene: Path, **changes) -> None:
    """Replace entries of a scene's transforms.json."""
    path = scene / "transforms.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def check_in_tritons_interpreter(program: str) -> None:
    """Run a program in which Triton's kernels, those of a CUDA machine, run anywhere; it says "equal" at its end."""
    pytest.importorskip("triton")
    process = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert process.stdout.strip() == "equal", process.stderr


def at_work(folder: Path) -> list[psutil.Process]:
    """Processes that have a folder on their command line."""
    return [p for p in psutil.process_iter(["cmdline"]) if any(str(folder) in a for a in p.info["cmdline"] or ())]
