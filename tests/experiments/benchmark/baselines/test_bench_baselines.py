"""Baselines through `ssa bench` as a user calls it: real processes, seconds each.

One each that changes the loss, the photos, the scene and the composite. The others are trained in tests of their own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

from baselines.training import train
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.experiments.benchmark import baselines
from ssa_nerfstudio.experiments.benchmark.results import read_all
from ssa_nerfstudio.experiments.benchmark.specification.method_matrix import METHODS, Method

WITH_WEIGHTS = ("difix3d", "flux-kontext")
BASELINES = ["spotless-mlp", "mask-detected", "desplat", "dc-gaussian"]
FILE = """
scenes:
  - data: demo
    model: {{num_downscales: 0, densify_grad_thresh: 0.006}}
parts:
  - {{methods: [{methods}], effects: [dashboard], steps: 12}}
"""
MODULE = """
from dataclasses import dataclass, field
from torch.nn.functional import avg_pool2d
from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Baseline, BaselineModel
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig

@dataclass
class BlurredConfig(SSASplatfactoModelConfig):
    _target: type = field(default_factory=lambda: BlurredModel)
    reach: int = 3

class BlurredModel(BaselineModel):
    def get_outputs(self, camera):
        drawn, reach = super().get_outputs(camera), self.config.reach
        return {**drawn, "composite": avg_pool2d(drawn["rgb"].permute(2, 0, 1), reach, 1, reach // 2).permute(1, 2, 0)}

BASELINE = Baseline(BlurredConfig)
"""
"""A module of a baseline: photos are taken for blurred ones."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("baselines")
    (folder / "few.yaml").write_text(FILE.format(methods=", ".join(BASELINES)))
    command = [
        sys.executable,
        "-m",
        "ssa_nerfstudio",
        "bench",
        folder / "few.yaml",
        "--output",
        folder,
        "--keep-models",
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return folder


@pytest.mark.slow
def test_each_one_is_trained_judged_and_timed_like_any_other_method(folder):
    results, problems = read_all([folder])
    assert problems == []
    assert {result.run.method: result.status for result in results} == dict.fromkeys(BASELINES, "finished")
    psnr: dict[str, Any] = {result.run.method: result.metrics["psnr"] for result in results}
    assert min(psnr.values()) > 8
    assert len({*psnr.values()}) == len(BASELINES)
    assert all(result.seconds["training"] > 0 for result in results)


@pytest.mark.slow
@pytest.mark.parametrize("method", BASELINES)
def test_nerfstudio_loads_what_was_trained(folder, method):
    (result,) = (result for result in read_all([folder])[0] if result.run.method == method)
    (config,) = (folder / "models" / result.run.id).rglob("config.yml")
    pipeline: Any = eval_setup(config, test_mode="inference")[1]
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    assert torch.isfinite(pipeline.model.get_outputs_for_camera(camera)["rgb"]).all()
    assert len(pipeline.model.means) == result.gaussians


def test_a_baseline_takes_one_module_and_one_line(capture, tmp_path, monkeypatch):
    (tmp_path / "blurred.py").write_text(MODULE)
    monkeypatch.setattr(baselines, "__path__", [*baselines.__path__, str(tmp_path)])
    monkeypatch.setitem(METHODS, "blurred", Method("Blurred", baseline="blurred"))
    _, pipeline = train("blurred", capture("clean"), tmp_path, 2, reach=5)
    camera, _ = pipeline.datamanager.next_train(0)
    pipeline.model.train()
    drawn: Any = pipeline.model.get_outputs(camera)
    expected = torch.nn.functional.avg_pool2d(drawn["rgb"].permute(2, 0, 1), 5, 1, 2).permute(1, 2, 0)
    torch.testing.assert_close(drawn["composite"], expected)


@pytest.mark.parametrize("method", WITH_WEIGHTS)
def test_without_weights_nothing_begins_and_one_line_says_what_to_fetch(tmp_path, capsys, method):
    (tmp_path / "few.yaml").write_text(FILE.format(methods=method))
    with pytest.raises(SystemExit) as refusal:
        main(["bench", str(tmp_path / "few.yaml"), "--output", str(tmp_path / "results")])
    assert refusal.value.code == 2
    line = capsys.readouterr().err
    assert "licence" in line
    assert len(line.strip().splitlines()) == 1
    assert not (tmp_path / "results" / "scenes").exists()


@pytest.mark.parametrize("made", [True, False])
@pytest.mark.parametrize(
    ("setting", "what"),
    [
        ("method: difix3d, weights", "nvidia/difix_ref"),
        ("method: flux-kontext, weights", "FLUX.1-Kontext-dev"),
        ("method: spotless-mlp, features", "stabilityai/stable-diffusion-2-1"),
    ],
)
def test_a_folder_without_weights_is_refused_before_anything_begins(tmp_path, capsys, setting, what, made):
    folder = tmp_path / "weights"
    if made:
        folder.mkdir()
    stated = f"candidates:\n  bare: {{{setting}: {folder}}}\n"
    (tmp_path / "few.yaml").write_text(stated + FILE.format(methods="bare"))
    with pytest.raises(SystemExit) as refusal:
        main(["bench", str(tmp_path / "few.yaml"), "--output", str(tmp_path / "results")])
    assert refusal.value.code == 2
    line = capsys.readouterr().err
    assert f"{folder} holds no weights (no model_index.json); fetch " in line
    assert what in line
    assert not (tmp_path / "results" / "scenes").exists()


@pytest.mark.parametrize("method", ["desplat", "dc-gaussian"])
def test_exposures_that_a_baseline_would_ignore_are_refused_before_anything_begins(tmp_path, capsys, method):
    (tmp_path / "few.yaml").write_text(FILE.format(methods=method).replace("{num", "{exposure: affine, num"))
    with pytest.raises(SystemExit) as refusal:
        main(["bench", str(tmp_path / "few.yaml"), "--output", str(tmp_path / "results")])
    assert refusal.value.code == 2
    assert "predicts photos without their exposures; set exposure: off for it" in capsys.readouterr().err
    assert not (tmp_path / "results" / "scenes").exists()
