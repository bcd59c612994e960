"""Captures of the built-in scene on which baselines do, or do not do, what their papers say; and 3DGS on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from baselines.training import STEPS, photos_of, train, with_reflection, with_squares
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.experiments.benchmark.baselines.robustnerf import residual
from ssa_nerfstudio.experiments.runs.training_run import Outcome
from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects
from ssa_nerfstudio.experiments.simulation.simulator import simulate
from ssa_nerfstudio.plugin.pipeline import SSAPipeline

SIZE = {"views": 24, "test_views": 4, "width": 64, "height": 48}


@pytest.fixture(scope="session")
def capture(tmp_path_factory, write_built_in_scene) -> Callable[[str], Path]:
    """The scene `clean`, behind a fixed effect or `reflection`, or with a `transient` elsewhere in each photo."""

    @cache
    def make(kind: str) -> Path:
        folder = tmp_path_factory.mktemp("capture") / kind
        if kind == "clean":
            return write_built_in_scene(folder, **SIZE)
        if kind == "transient":
            return with_squares(make("clean"), folder)
        if kind == "reflection":
            return with_reflection(make("clean"), folder)
        simulate(Dataset.read(make("clean"), eval_interval=8), Scene(read_effects((kind,)), seed=0), folder, threads=1)
        return folder

    return make


@pytest.fixture(scope="session")
def trained(capture, tmp_path_factory) -> Callable[[str, str], tuple[Outcome, SSAPipeline]]:
    """A method trained on a capture, once."""
    return cache(lambda method, kind: train(method, capture(kind), tmp_path_factory.mktemp(method), STEPS))


@pytest.fixture(scope="session")
def gain(trained) -> Callable[[str, str], float]:
    """PSNR of the test views, in dB, above that of 3DGS on the same capture."""
    return lambda method, kind: trained(method, kind)[0].metrics["psnr"] - trained("3dgs", kind)[0].metrics["psnr"]


@pytest.fixture(scope="session")
def kept(capture, trained) -> Callable[[str, str], float]:
    """Share of the pixels that the artifact changed which a trained filter takes for inliers, mean over photos."""

    def measure(method: str, kind: str) -> float:
        pipeline: Any = trained(method, kind)[1]
        model = pipeline.model
        model.train()
        shares = []
        for _ in range(SIZE["views"]):
            camera, batch = pipeline.datamanager.next_train(0)
            outputs = model.get_outputs(camera)
            target = model.target(outputs, batch)
            photo = photos_of(capture("clean"))[batch["image_idx"]]
            changed = (target - torch.from_numpy(np.array(Image.open(photo))) / 255).abs().amax(dim=-1) > 0.05
            inlier = model.inlier_weights(residual(outputs["rgb"], target), batch)[..., 0]
            shares.append(float(inlier[changed].mean()))
        return sum(shares) / len(shares)

    return measure


@pytest.fixture(scope="session")
def baked(capture, trained) -> Callable[[str, str], float]:
    """How much of the artifact the clean scene shows in the training views: 1 all of it, 0 none.

    The regression of what the render has too much on what the artifact changed, over the pixels that it changed.
    """

    def measure(method: str, kind: str) -> float:
        pipeline: Any = trained(method, kind)[1]
        model, datamanager = pipeline.model, pipeline.datamanager
        model.eval()
        excess, change = [], []
        with torch.no_grad():
            for number, photo in enumerate(photos_of(capture("clean"))):
                camera = datamanager.train_dataset.cameras[number : number + 1]
                clean = torch.from_numpy(np.array(Image.open(photo))) / 255
                shown = datamanager.cached_train[number]["image"] / 255 - clean
                changed = shown.abs().amax(dim=-1) > 0.05
                excess.append((model.get_outputs(camera)["rgb"] - clean)[changed].flatten())
                change.append(shown[changed].flatten())
        together, alone = torch.cat(excess), torch.cat(change)
        return float(together @ alone / (alone @ alone))

    return measure
