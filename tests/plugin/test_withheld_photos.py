"""Test photos with the artifact help to decide whether there is one, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from ssa_nerfstudio.plugin.pipeline import SSAPipeline

Starts = Callable[..., SSAPipeline]


@pytest.fixture
def six_photos(broken_scene: Path) -> Path:
    """A dashboard in front of six photos: as few as detection takes, and nerfstudio holds one of them back."""
    path = broken_scene / "transforms.json"
    meta = json.loads(path.read_text())
    covered = {*meta["train_filenames"][:6]}
    meta["frames"] = [frame for frame in meta["frames"] if frame["file_path"] in covered]
    path.write_text(json.dumps({key: value for key, value in meta.items() if not key.endswith("_filenames")}))
    return broken_scene


@pytest.fixture
def start(configure_training, tmp_path) -> Starts:
    def start(data: Path, overlay: str) -> SSAPipeline:
        """The pipeline before the first step, by the photos alone."""
        torch.manual_seed(0)
        np.random.seed(0)  # noqa: NPY002 - nerfstudio draws from numpy's global generator
        config = configure_training("ssa-splatfacto", data, tmp_path / "runs", 1, {"overlay": overlay})
        config.pipeline.datamanager.dataparser.load_3D_points = False
        return config.pipeline.setup(device="cpu")

    return start


def test_what_too_few_training_photos_show_is_decided_with_the_test_photos(six_photos, start, capsys):
    auto = start(six_photos, "auto")
    told = " ".join(capsys.readouterr().out.split())
    assert "have a static artifact, with the test photos (" in told
    assert len(auto.datamanager.train_dataset) == 5
    assert len(auto.model.artifacts) == 1
    forced = start(six_photos, "on")
    ours, theirs = (pipeline.model.artifacts.state_dict() for pipeline in (auto, forced))
    for name, values in theirs.items():
        if torch.is_tensor(values):
            assert torch.equal(ours[name], values), f"{name} is not of the training photos alone"


def test_test_photos_that_are_stated_are_clean_and_are_not_asked(six_photos, start, capsys):
    path = six_photos / "transforms.json"
    meta = json.loads(path.read_text())
    first, *others = (frame["file_path"] for frame in meta["frames"])
    split = {"train_filenames": others, "val_filenames": [first], "test_filenames": [first]}
    path.write_text(json.dumps({**meta, **split}))
    assert len(start(six_photos, "auto").model.artifacts) == 0
    assert "too few to tell" in " ".join(capsys.readouterr().out.split())
