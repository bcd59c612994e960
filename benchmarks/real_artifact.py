"""Learned matte of a real artifact against its mask: `python benchmarks/real_artifact.py --data dashcam_hood`

There are no clean views to compare with, only an approximate mask of the artifact in the raw frame, white on the
artifact. It is compared in the undistorted frame. The mean matte of the frame's upper third is printed, too: there is
sky, which hardly changes from view to view and must not become artifact.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch.nn.functional as F

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, Factor, Method
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.metrics.artifact_region import ArtifactRegion
from ssa_nerfstudio.metrics.matte import matte_iou

MASK = "artifact_mask_approx.png"
"""Name of the mask in the dataset."""


@dataclass
class Command:
    """Train on a capture with a real artifact, and print one line of metrics of the matte."""

    data: Path
    """A nerfstudio dataset with artifact_mask_approx.png."""
    method: Method = "ssa-splatfacto"
    """Method to train with."""
    steps: Count = 30_000
    """Training steps; every schedule is scaled to them."""
    scale_factor: Factor = 1.0
    """Photos are resized by this."""
    settings: tuple[str, ...] = ()
    """Settings of the model as name=value, for example overlay_start=statistics."""

    def run(self) -> None:
        """Train and print.

        Raises:
            InputError: the dataset has no mask, or cannot be trained on.
        """
        if not (self.data / MASK).is_file():
            raise InputError(f"{self.data / MASK} does not exist", "name a dataset with a mask of its artifact")
        from ssa_nerfstudio.experiments.runs.run_configuration import configure, model_settings
        from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate

        region = ArtifactRegion.read(self.data / MASK, Dataset.read(self.data, eval_interval=8).views[0].lens)
        model = model_settings(self.settings)
        with tempfile.TemporaryDirectory() as scratch:
            config = configure(self.method, self.data, Path(scratch), self.steps, model, self.scale_factor)
            outcome, pipeline, _ = train_and_evaluate(config)
        row = [f"{self.method} {' '.join(self.settings)}".strip(), f"PSNR {outcome.metrics['psnr']:.2f}"]
        for overlay in pipeline.model.artifacts.learned():
            matte = overlay.matte().detach().cpu()[..., 0]
            mask = F.interpolate(region.inside.float()[None, None], size=matte.shape, mode="area")[0, 0] > 0.5
            row.append(f"IoU {matte_iou(matte, mask):.3f}")
            row += [f"{name.replace('_', ' ')} {value:.3f}" for name, value in region.mattes(matte).items()]
        print("; ".join(row))


if __name__ == "__main__":
    run_script(Command)
