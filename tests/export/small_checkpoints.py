"""Checkpoints as ns-train writes them, made without training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ssa_nerfstudio.cameras.lens import Lens, undistorted_lens
from ssa_nerfstudio.overlay.layer import OracleOverlay, ScreenSpaceOverlay
from ssa_nerfstudio.plugin.artifacts import Artifacts


def random_gaussians(count: int, bands: int = 15, seed: int = 0) -> dict[str, torch.Tensor]:
    """Parameters of `count` Gaussians with `bands` harmonics besides the constant one."""
    generator = torch.Generator().manual_seed(seed)
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,),
        "scales": (3,),
        "quats": (4,),
        "opacities": (1,),
        "features_dc": (3,),
    }
    shapes["features_rest"] = (bands, 3)
    return {name: torch.randn(count, *shape, generator=generator) for name, shape in shapes.items()}


def one_camera(overlay: ScreenSpaceOverlay | OracleOverlay, lens: Lens | None = None) -> Artifacts:
    """An artifact in front of one camera; its lens has no distortion unless one is given."""
    return cameras([(overlay, lens or Lens(overlay.width, overlay.height, 50, 50, overlay.width / 2, 20))])


def cameras(pairs: list[tuple]) -> Artifacts:
    """Artifacts of a rig: an overlay and its raw lens for each camera."""
    targets = [undistorted_lens(lens) for _, lens in pairs]
    keys = [[t.width, t.height, t.fx, t.fy, t.cx, t.cy] for t in targets]
    lenses = [
        [lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion, 1 + (lens.model == "fisheye")]
        for _, lens in pairs
    ]
    artifacts = Artifacts()
    artifacts.assign([o for o, _ in pairs], _float64(keys), [], _float64(lenses))
    return artifacts


def _float64(rows: list) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def write_run(folder: Path, artifacts: Artifacts | None, gaussians: dict | None = None, step: int = 9) -> Path:
    """A run's folder with one checkpoint; returns its config.yml."""
    state = {f"_model.gauss_params.{k}": v for k, v in (gaussians or random_gaussians(3)).items()}
    state |= {f"_model.artifacts.{k}": v for k, v in (artifacts or Artifacts()).state_dict().items()}
    (folder / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
    # As nerfstudio's: the schedulers leave a numpy scalar in it.
    saved = {"step": step, "pipeline": state, "schedulers": {"means": {"last_lr": np.float64(1e-3)}}}
    torch.save(saved, folder / "nerfstudio_models" / f"step-{step:09d}.ckpt")
    (folder / "config.yml").write_text("!!python/object:nerfstudio.engine.trainer.TrainerConfig {}\n")
    return folder / "config.yml"
