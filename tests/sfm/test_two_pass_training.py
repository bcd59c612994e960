"""A capture in two passes from photos to figures: `ssa process`, `ns-train`, `ns-eval`, each as its own process.

And on from there: the matte that was learned is the mask of a second structure from motion.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_captures import HEIGHT, WIDTH, write

from ssa_nerfstudio.cli import main
from ssa_nerfstudio.sfm.nerfstudio_dataset import MASK

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent


def run(*command: object) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=400, env=environment)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


def test_artifact_photos_train_and_clean_photos_judge_and_the_matte_is_a_mask_for_poses(tmp_path, draw_effect, photos):
    layers = draw_effect("dashboard", HEIGHT, WIDTH)
    pictures = photos(16)
    # No mask: what is the same in all photos is found by the command itself.
    train = write(tmp_path / "artifact", [layers.apply(picture) for picture in pictures[::2]])
    clean = write(tmp_path / "clean", pictures[1::2])
    data = tmp_path / "data"
    said = run(
        sys.executable, "-m", "ssa_nerfstudio", "process", "--train", train, "--clean", clean, "--output", data,
        "--threads", 1, "--min-registered", 0.9,
    )  # fmt: skip
    assert "train: 8 of 8 photos registered\nclean: 8 of 8 photos registered\n" in said
    run(
        BIN / "ns-train", "ssa-splatfacto", "--data", data, "--output-dir", tmp_path / "runs", "--vis", "tensorboard",
        "--max-num-iterations", 120, "--timestamp", "t", "--pipeline.model.num-downscales", 1,
        "--pipeline.model.stop-split-at", 1,
    )  # fmt: skip
    config = tmp_path / "runs/data/ssa-splatfacto/t/config.yml"
    run(BIN / "ns-eval", "--load-config", config, "--output-path", tmp_path / "eval.json")
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    # The clean render is nearer to the clean photos than the photo behind the dashboard that was trained on.
    assert results["psnr"] > 12
    assert results["psnr"] > results["composite_psnr"] + 1

    overlay, again = tmp_path / "overlay", tmp_path / "again"
    main(["export-overlay", "--load-config", str(config), "--raw-frame", "--output", str(overlay)])
    mask = overlay / "mask_white_is_scene.png"
    # Without flattening it is the mask alone that keeps the dashboard out of the poses.
    main([
        "process", "--train", str(train), "--clean", str(clean), "--output", str(again), "--mask", str(mask),
        "--no-flatten", "--no-filter-stationary", "--threads", "1", "--min-registered", "0.9",
    ])  # fmt: skip
    used = np.asarray(Image.open(again / MASK))
    covered = layers.transmittance.min(axis=-1) < 0.1
    assert used.shape == (HEIGHT, WIDTH)
    assert (~used)[covered].mean() > 0.9
    assert used[~covered].mean() > 0.8
