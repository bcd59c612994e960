"""Real captures on a CPU: short trainings at a fraction of the resolution. docs/results.md has the full ones."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks.detection_rates import detections, stretches
from benchmarks.real_artifact import undistorted_mask
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.data.dataset import Dataset

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
    """The default settings. 60 steps move a matte little from where it starts; docs/results.md has one of 1500."""
    data = captures / "dashcam_hood"
    model = {"num_downscales": 0, "stop_split_at": 1}
    _, pipeline, _ = train_and_evaluate(
        configure_training("ssa-splatfacto", data, tmp_path, 60, model, scale_factor=0.25)
    )
    matte = pipeline.model.artifacts.learned()[0].matte().detach()[..., 0]
    bonnet = undistorted_mask(data, (len(matte), matte.shape[1]))
    assert torch.isfinite(matte).all()
    assert matte[: len(matte) // 3].mean() < 0.1
    assert matte[bonnet].mean() > 0.3


def test_a_short_clip_of_a_walk_straight_ahead_is_clean_and_a_watermark_in_it_is_found(captures):
    """The scenery far ahead hardly moves; docs/detect.md has all lengths, captures and effects."""
    walk = Dataset.read(captures / "gopro_walk", eval_interval=8)
    clips = [*stretches(len(walk.views), 8), *stretches(len(walk.views), 24)]
    assert {found.verdict for found in detections(walk, None, 0, clips)} == {"none"}
    assert "none" not in {found.verdict for found in detections(walk, "watermark", 0, clips)}
