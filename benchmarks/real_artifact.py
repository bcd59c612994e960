"""Learned matte of a real artifact against its mask: `python benchmarks/real_artifact.py --data dashcam_hood`

There are no clean views to compare with, only an approximate mask of the artifact in the raw frame, white on the
artifact. It is compared in the undistorted frame. The mean matte of the frame's upper third is printed, too: there is
sky, which hardly changes from view to view and must not become artifact. With --beside-off also a training without an
overlay, compared outside the mask: whatever stays in its place in every photo, as a car ahead does, the overlay takes,
but test photos show it. Distant and gap seeds come with the overlay; distant_seeds=False and gap_seeds=False among the
settings leave them out.
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
    """Training photos are resized by this; test photos keep their size."""
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
        if self.beside_off and "overlay=off" in self.settings:
            raise InputError("--beside-off: --settings state overlay=off", "leave one of them out")
        if not (self.data / MASK).is_file():
            raise InputError(f"{self.data / MASK} does not exist", "name a dataset with a mask of its artifact")
        region = ArtifactRegion.read(self.data / MASK, Dataset.read(self.data, eval_interval=8).views[0].lens)
        if not (region.inside.any() and region.outside.any()):
            where = "inside" if region.outside.any() else "outside"
            raise InputError(f"{self.data / MASK} leaves no pixel {where}", "give a mask that is white on the artifact")
        outcome, pipeline = self._train(region)
        row = [f"{self.method} {' '.join(self.settings)}".strip(), f"PSNR {outcome.metrics['psnr']:.2f}"]
        mattes = [overlay.matte().detach().cpu()[..., 0] for overlay in pipeline.model.artifacts.learned()]
        for matte in mattes:
            mask = F.interpolate(region.inside.float()[None, None], size=matte.shape, mode="area")[0, 0] > 0.5
            row.append(f"IoU {matte_iou(matte, mask):.3f}")
            row += [f"{name.replace('_', ' ')} {value:.3f}" for name, value in region.mattes(matte).items()]
        print("; ".join(row))
        if self.beside_off:
            self._compare(region, outcome, pipeline, mattes)

    def _compare(
        self, region: ArtifactRegion, outcome: Outcome, pipeline: SSAPipeline, mattes: Sequence[Tensor]
    ) -> None:
        """Train without an overlay and print the PSNR of both outside the mask."""
        from ssa_nerfstudio.experiments.runs.flip_processes import FlipProcesses
        from ssa_nerfstudio.experiments.runs.training_run import evaluate

        if not mattes:
            print("no overlay was trained: there is nothing to compare")
            return
        shown = replace(region, outside=region.outside & ~hidden_by(mattes, region.outside.shape))
        print(f"hidden outside the mask {1 - float(shown.outside.sum() / region.outside.sum()):.1%}")
        off, without = self._train(region, "overlay=off")
        print("| outside the mask, dB | off | with an overlay |", "|---|---|---|", sep="\n")
        print(f"| everywhere | {outside(off.views)} | {outside(outcome.views)} |")
        if shown.outside.any():
            both = [outside(evaluate(each, FlipProcesses(1), shown)) for each in (without, pipeline)]
            print(f"| where the overlay hides less than half | {' | '.join(both)} |")

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
