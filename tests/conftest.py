"""What the tests share: real captures, a tiny scene, and the experiments as fixtures.

Tests of the product do not import the experiments; tests/test_layout.py holds that.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest
import torch

if TYPE_CHECKING:
    from ssa_nerfstudio.experiments.effects.layers import Layers

FIRST = ("workflow/test_run.py", "plugin/test_commands.py", "plugin/test_browser.py")
"""Modules whose tests share a long training. An idle worker takes tests from the end of another's: in the middle, or at
the end, it would train again."""

torch.set_num_threads(1)
# A shell's background jobs and nohup ignore them, and what a test starts would inherit that.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests that share a training first."""
    items.sort(key=lambda item: not item.path.as_posix().endswith(FIRST))


@pytest.fixture(scope="session")
def captures() -> Path:
    """The folder of real captures: $SSA_DATA, or data/ in the working directory."""
    folder = Path(os.environ.get("SSA_DATA", "data"))
    if not (folder / "fox" / "transforms.json").exists():
        pytest.skip(f"no real captures in {folder}; set SSA_DATA to the folder that holds fox, plush, ...")
    return folder


@pytest.fixture(scope="session")
def configure_training() -> Callable:
    """From the experiments: `configure`, a method's configuration for an unattended run."""
    from ssa_nerfstudio.experiments.runs.run_configuration import configure

    return configure


@pytest.fixture(scope="session")
def train_resumable(configure_training, tmp_path_factory: pytest.TempPathFactory) -> Callable:
    """Train unscaled and seeded, given dataset, steps, settings of the model, and checkpoints to go on from."""

    def train(data: Path, steps: int, model: dict, load_dir: Path | None = None):
        config = configure_training("ssa-splatfacto", data, tmp_path_factory.mktemp("run"), steps, model)
        config.load_dir, config.vis = load_dir, "tensorboard"
        config.scale_schedules = False
        config.set_timestamp()
        config.save_config()
        random.seed(0)
        torch.manual_seed(0)
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.train()
        return trainer

    return train


@pytest.fixture(scope="session")
def train_and_evaluate() -> Callable:
    """From the experiments: `train_and_evaluate`, a training to its end and the metrics of its test views."""
    from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate

    return train_and_evaluate


@pytest.fixture(scope="session")
def training_imports() -> str:
    """From the experiments: what imports the two in a program that a test runs as a process of its own."""
    runs = "ssa_nerfstudio.experiments.runs"
    configure = f"from {runs}.run_configuration import configure as configure_training\n"
    return configure + f"from {runs}.training_run import train_and_evaluate\n"


@pytest.fixture(scope="session")
def draw_effect() -> Callable[..., Layers]:
    """From the experiments: draws an effect, given its name, height and width in pixels, and a seed."""
    from ssa_nerfstudio.experiments.effects.catalogue import effect_class
    from ssa_nerfstudio.experiments.effects.layers import Layers

    def draw(name: str, height: int, width: int, seed: int = 0) -> Layers:
        layers = effect_class(name)().layers(height, width, np.random.default_rng(seed))
        assert isinstance(layers, Layers), f"{name} varies from view to view"
        return layers

    return draw


@pytest.fixture(scope="session")
def composited_layers() -> Callable[..., Layers]:
    """From the experiments: `Layers.composited`, the layers of a matte and a color."""
    from ssa_nerfstudio.experiments.effects.layers import Layers

    return Layers.composited


@pytest.fixture(scope="session")
def undistorted_layers() -> Callable[..., Layers]:
    """From the experiments: `undistorted_layers`, an artifact of the raw frame in the undistorted one."""
    from ssa_nerfstudio.experiments.simulation.corruption import undistorted_layers

    return undistorted_layers


@pytest.fixture(scope="session")
def write_built_in_scene() -> Callable[..., Path]:
    """From the experiments: writes the built-in scene, given the folder, its fields and the artifact in front."""
    from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

    def write(folder: Path, artifact: Layers | None = None, **fields: int) -> Path:
        DemoScene(**fields).write(folder, artifact)
        return folder

    return write


@pytest.fixture(scope="session")
def photos() -> Callable[[int], list[np.ndarray]]:
    """From the experiments: renders of the built-in scene along `small_captures.poses`, given their number.

    Small, uint8 [168, 224, 3], and textured enough for structure from motion.
    """
    from small_captures import HEIGHT, WIDTH, poses

    from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

    scene = DemoScene(width=WIDTH, height=HEIGHT)
    return cache(lambda count: [scene.render(pose) for pose in poses(count)])


@pytest.fixture(scope="session")
def trace_built_in_scene() -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """From the experiments: rays in the built-in scene, for cameras of any kind (`wide_captures`)."""
    from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene

    return DemoScene().trace


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory, write_built_in_scene, draw_effect) -> Path:
    """A dataset of 12 training views of 64 x 48 pixels behind a dashboard, and 3 clean test views. Read only."""
    folder = tmp_path_factory.mktemp("scene") / "dashboard"
    return write_built_in_scene(folder, draw_effect("dashboard", 48, 64), views=12, test_views=3, width=64, height=48)


@pytest.fixture
def broken_scene(tiny_scene: Path, tmp_path: Path) -> Path:
    """A copy of the tiny scene for a test to break."""
    return Path(shutil.copytree(tiny_scene, tmp_path / "scene"))


@pytest.fixture
def scene_of_two_cameras(broken_scene: Path) -> Path:
    """The tiny scene, photographed by two cameras in turn, whose principal points differ."""
    path = broken_scene / "transforms.json"
    transforms = json.loads(path.read_text())
    shared = {name: transforms.pop(name) for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    for number, frame in enumerate(transforms["frames"]):
        frame |= {**shared, "cx": shared["cx"] + 1.5 * (number % 2)}
    path.write_text(json.dumps(transforms))
    return broken_scene


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
