"""Real captures on a CPU: short trainings at a fraction of the resolution. docs/results.md has the full ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from ssa_nerfstudio.benchmark.run import configure, train_and_evaluate
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.overlay.lens import Lens, undistort

pytestmark = pytest.mark.slow


def psnr(data: Path, output: Path, overlay: str) -> float:
    model = {"overlay": overlay, "num_downscales": 0, "stop_split_at": 1}
    config = configure("ssa-splatfacto", data, output / overlay, 150, model, scale_factor=0.125)
    return train_and_evaluate(config)[0].metrics["psnr"]


def test_the_overlay_removes_a_dashboard_from_real_photos(captures, tmp_path):
    main(["simulate", "--data", str(captures / "fox"), "--output", str(tmp_path / "fox"), "--effects", "dashboard"])
    assert psnr(tmp_path / "fox", tmp_path, "on") > psnr(tmp_path / "fox", tmp_path, "off") + 2.0


def test_a_real_dashcam_trains_and_l1_keeps_its_constant_sky_out_of_the_overlay(captures, tmp_path):
    """250 steps leave much of the start in place; docs/results.md has the matte after 7000."""
    data = captures / "dashcam_hood"
    upper, bonnet = {}, {}
    for kind in ("l1", "off"):
        model = {"num_downscales": 0, "stop_split_at": 1, "sparsity": kind}
        config = configure("ssa-splatfacto", data, tmp_path, 250, model, scale_factor=0.125)
        config.optimizers["overlay"]["optimizer"].lr = 0.02
        _, pipeline, _ = train_and_evaluate(config)
        matte = pipeline.model.artifacts.learned()[0].matte().detach()[..., 0]
        mask = undistorted_mask(data, (len(matte), matte.shape[1]))
        assert torch.isfinite(matte).all()
        upper[kind], bonnet[kind] = matte[: len(matte) // 3].mean(), matte[mask].mean()
    assert upper["l1"] < upper["off"] - 0.1, (upper, bonnet)
    assert bonnet["off"] > 0.3, (upper, bonnet)


def undistorted_mask(data: Path, size: tuple[int, int]) -> torch.Tensor:
    """The approximate mask of the bonnet [H, W] in the frame that the model sees, at its resolution."""
    camera = json.loads((data / "transforms.json").read_text())
    distortion = tuple(camera.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    width, height, fx, fy, cx, cy = (camera[name] for name in ("w", "h", "fl_x", "fl_y", "cx", "cy"))
    lens = Lens(width, height, fx, fy, cx, cy, distortion)
    raw = np.asarray(Image.open(data / "artifact_mask_approx.png").convert("L"), np.float32) / 255
    straight = undistort(np.repeat(raw[..., None], 3, axis=2), lens)[..., 0]
    mask = F.interpolate(torch.from_numpy(straight)[None, None], size=size, mode="area")[0, 0]
    return mask > 0.5
