"""Real captures on a CPU: short trainings at a fraction of the resolution. docs/results.md has the full ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.detection_rates import detections, stretches
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.evidence.capture_detection import detect_artifacts

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def psnr(configure_training, train_and_evaluate):
    def psnr(data: Path, output: Path, overlay: str) -> float:
        model = {"overlay": overlay, "num_downscales": 0, "stop_split_at": 1}
        config = configure_training("ssa-splatfacto", data, output / overlay, 150, model, scale_factor=0.125)
        return train_and_evaluate(config)[0].metrics["psnr"]

    return psnr


def test_the_overlay_removes_a_dashboard_from_real_photos(captures, tmp_path, psnr):
    main(["simulate", "--data", str(captures / "fox"), "--output", str(tmp_path / "fox"), "--effects", "dashboard"])
    assert psnr(tmp_path / "fox", tmp_path, "on") > psnr(tmp_path / "fox", tmp_path, "off") + 2.0


def test_a_real_bonnet_is_found_and_the_constant_sky_stays_out_of_the_overlay(
    captures, tmp_path, configure_training, train_and_evaluate
):
    """The default settings. 60 steps move a matte little from where it starts: clear on the bonnet, too."""
    data = captures / "dashcam_hood"
    found = detect_artifacts(data)["camera_0"]
    bonnet = np.array(Image.open(data / "artifact_mask_approx.png").convert("L")) > 127
    assert found.verdict != "none"
    assert found.mask[torch.from_numpy(bonnet)].float().mean() > 0.3
    assert found.mask[: len(bonnet) // 3].float().mean() < 0.01
    model = {"num_downscales": 0, "stop_split_at": 1}
    _, pipeline, _ = train_and_evaluate(
        configure_training("ssa-splatfacto", data, tmp_path, 60, model, scale_factor=0.25)
    )
    matte = pipeline.model.artifacts.learned()[0].matte().detach()[..., 0]
    assert torch.isfinite(matte).all()
    assert matte[: len(matte) // 3].mean() < 0.1


def test_a_short_clip_of_a_walk_straight_ahead_is_clean_and_a_watermark_in_it_is_found(captures):
    """The scenery far ahead hardly moves; docs/detect.md has all lengths, captures and effects."""
    walk = Dataset.read(captures / "gopro_walk", eval_interval=8)
    clips = [*stretches(len(walk.views), 8), *stretches(len(walk.views), 24)]
    assert {found.verdict for found in detections(walk, None, 0, clips)} == {"none"}
    assert "none" not in {found.verdict for found in detections(walk, "watermark", 0, clips)}


@pytest.mark.parametrize(("effect", "moves"), [("occlusion", True), ("ui", False)])
def test_the_scene_learns_nothing_behind_what_sways_and_all_the_rest(
    captures, tmp_path, configure_training, train_and_evaluate, effect, moves
):
    """An occlusion moves by two pixels and its light changes by 15 %; buttons do neither."""
    data = tmp_path / effect
    main(["simulate", "--data", str(captures / "fox"), "--output", str(data), "--effects", effect])
    _, pipeline, _ = train_and_evaluate(configure_training("ssa-splatfacto", data, tmp_path, 1, {}, scale_factor=0.5))
    learned = pipeline.model.artifacts.learned()[0].reliable[..., 0] > 0
    if not moves:
        assert learned.all()
        return
    with np.load(data / "layers" / "undistorted.npz") as layers:
        truth = layers["T"].mean(axis=-1)
    hidden = torch.from_numpy(truth[::2, ::2] < 0.5)[: len(learned), : learned.shape[1]]
    assert learned[hidden].float().mean() < 0.05
    assert learned[~hidden].float().mean() > 0.95
