"""Learned matte of a real artifact against its mask: `python benchmarks/real_artifact.py --data dashcam_hood`

There are no clean views to compare with, only an approximate mask of the artifact in the raw frame, white on the
artifact. It is compared in the undistorted frame. The mean matte of the frame's upper third is printed, too: there is
sky, which hardly changes from view to view and must not become artifact. With --beside-off also what the overlay costs
elsewhere: whatever stays in its place in every photo, as a car ahead does, is an artifact to it, and a part of the test
photos.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, Factor, Method
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.metrics.artifact_region import ArtifactRegion
from ssa_nerfstudio.metrics.matte import matte_iou

if TYPE_CHECKING:
    from ssa_nerfstudio.experiments.runs.training_run import Outcome
    from ssa_nerfstudio.plugin.pipeline import SSAPipeline

MASK = "artifact_mask_approx.png"
"""Name of the mask in the dataset."""


def hidden_by(mattes: Sequence[Tensor], size: Sequence[int]) -> Tensor:
    """Where one of the mattes [h, w] hides more than half, [H, W] bool of that size."""
    hidden = torch.zeros(*size, dtype=torch.bool)
    for matte in mattes:
        hidden |= F.interpolate(matte[None, None], size=tuple(size), mode="bilinear")[0, 0] > 0.5
    return hidden


def outside(views: Mapping[str, Mapping[str, float]]) -> str:
    """PSNR outside the region: the mean over views, and each of them."""
    values = [view["outside_psnr"] for view in views.values()]
    return f"{statistics.mean(values):.2f} ({', '.join(f'{value:.1f}' for value in values)})"


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
    beside_off: bool = False
    """Train without an overlay, too, and print the PSNR of both outside the mask, view by view: everywhere, and where
    the overlay hides less than half."""

    def run(self) -> None:
        """Train and print.

        Raises:
            InputError: the dataset has no mask, or cannot be trained on.
        """
        if not (self.data / MASK).is_file():
            raise InputError(f"{self.data / MASK} does not exist", "name a dataset with a mask of its artifact")
        from ssa_nerfstudio.experiments.runs.flip_processes import FlipProcesses
        from ssa_nerfstudio.experiments.runs.training_run import evaluate

        region = ArtifactRegion.read(self.data / MASK, Dataset.read(self.data, eval_interval=8).views[0].lens)
        outcome, pipeline = self._train(region)
        row = [f"{self.method} {' '.join(self.settings)}".strip(), f"PSNR {outcome.metrics['psnr']:.2f}"]
        mattes = [overlay.matte().detach().cpu()[..., 0] for overlay in pipeline.model.artifacts.learned()]
        for matte in mattes:
            mask = F.interpolate(region.inside.float()[None, None], size=matte.shape, mode="area")[0, 0] > 0.5
            row.append(f"IoU {matte_iou(matte, mask):.3f}")
            row += [f"{name.replace('_', ' ')} {value:.3f}" for name, value in region.mattes(matte).items()]
        print("; ".join(row))
        if self.beside_off:
            shown = replace(region, outside=region.outside & ~hidden_by(mattes, region.outside.shape))
            print(f"hidden outside the mask {1 - float(shown.outside.sum() / region.outside.sum()):.1%}")
            off, without = self._train(region, "overlay=off")
            shown_by_both = (evaluate(each, FlipProcesses(1), shown) for each in (without, pipeline))
            print("| outside the mask, dB | off | with an overlay |", "|---|---|---|", sep="\n")
            for where, views in (
                ("everywhere", (off.views, outcome.views)),
                ("where the overlay hides less than half", shown_by_both),
            ):
                print(f"| {where} | {' | '.join(map(outside, views))} |")

    def _train(self, region: ArtifactRegion, *settings: str) -> tuple[Outcome, SSAPipeline]:
        from ssa_nerfstudio.experiments.runs.run_configuration import configure, model_settings
        from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate

        model = model_settings((*self.settings, *settings))
        with tempfile.TemporaryDirectory() as scratch:
            config = configure(self.method, self.data, Path(scratch), self.steps, model, self.scale_factor)
            outcome, pipeline, _ = train_and_evaluate(config, test_scale=1.0, region=region)
        return outcome, pipeline


if __name__ == "__main__":
    run_script(Command)
