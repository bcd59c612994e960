"""Trainings of a method as a benchmark's process configures them, and captures made for them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from ssa_nerfstudio.experiments.benchmark.baselines.baseline import find
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import ResultsFolder
from ssa_nerfstudio.experiments.benchmark.execution.run_process import configuration
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Benchmark, Part, SceneEntry
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan
from ssa_nerfstudio.experiments.runs.training_run import Outcome, train_and_evaluate
from ssa_nerfstudio.plugin.pipeline import SSAPipeline

STEPS = 400
"""Enough for a distractor to do its harm."""
SMALL = {"num_downscales": 0, "densify_grad_thresh": 0.006, "background_color": "black"}


def train(method: str, capture: Path, folder: Path, steps: int, **model) -> tuple[Outcome, SSAPipeline]:
    """Train a method of the benchmark on a prepared capture, and evaluate it."""
    part = Part((method,), ("mud",), steps=steps)
    (run,) = plan(Benchmark((SceneEntry(str(capture), model={**SMALL, **model}),), (part,)))
    place = ResultsFolder(folder / method)
    place.scenes.mkdir(parents=True)
    (place.scenes / run.dataset).symlink_to(capture)
    find(run.baseline).make_dataset(run, place.scenes / run.dataset, place.artifacts)
    outcome, pipeline, _ = train_and_evaluate(configuration(run, place))
    return outcome, pipeline


def photos_of(capture: Path) -> list[Path]:
    """Files of the training photos."""
    return [capture / name for name in json.loads((capture / "transforms.json").read_text())["train_filenames"]]


def with_squares(clean: Path, folder: Path) -> Path:
    """A copy whose training photos show a magenta square of half their height, elsewhere in each."""
    capture = Path(shutil.copytree(clean, folder))
    generator = np.random.default_rng(0)
    for path in photos_of(capture):
        pixels = np.array(Image.open(path).convert("RGB"))
        side = pixels.shape[0] // 2
        top, left = (generator.integers(0, size - side) for size in pixels.shape[:2])
        pixels[top : top + side, left : left + side] = (255, 0, 255)
        Image.fromarray(pixels).save(path)
    return capture


def reflection(height: int, width: int) -> np.ndarray:
    """Light [H, W, 3] that a windscreen adds in the lower half of the frame: bars of a dashboard."""
    y, x = np.mgrid[:height, :width] / np.array([height, width])[:, None, None]
    return 0.35 * ((np.sin(25.0 * x) > 0) & (y > 0.5))[..., None] * np.array([1.0, 0.9, 0.7])


def with_reflection(clean: Path, folder: Path) -> Path:
    """A copy whose training photos all show `reflection` over the scene."""
    capture = Path(shutil.copytree(clean, folder))
    for path in photos_of(capture):
        pixels = np.array(Image.open(path).convert("RGB")) / 255.0
        shown = (pixels + reflection(*pixels.shape[:2])).clip(0, 1)
        Image.fromarray(np.rint(255 * shown).astype(np.uint8)).save(path)
    return capture
