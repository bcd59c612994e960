"""One training through nerfstudio's own trainer, evaluated and timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import rich
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from ssa_nerfstudio.errors import TrainingError
from ssa_nerfstudio.experiments.runs.flip_processes import FlipProcesses
from ssa_nerfstudio.experiments.runs.machine import versions
from ssa_nerfstudio.experiments.runs.prepared_trainer import begin_run, set_up_trainer
from ssa_nerfstudio.experiments.runs.run_timing import StepClock, TimedDatamanager, TimedPipeline, mean_metrics
from ssa_nerfstudio.metrics.artifact_region import ArtifactRegion
from ssa_nerfstudio.plugin.evaluation import view_metrics_without_flip
from ssa_nerfstudio.plugin.model import SSASplatfactoModel
from ssa_nerfstudio.plugin.pipeline import SSAPipeline
from ssa_nerfstudio.plugin.trainer import SSATrainer, SSATrainerConfig
from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left
from ssa_nerfstudio.plugin.training.step_callbacks import after_each_step

INVISIBLE = 1 / 255
"""Opacity below which a rasterizer skips a Gaussian."""


class Diverged(TrainingError):
    """A training that left nothing to evaluate: values that are not finite, or no Gaussian that can be seen."""


@dataclass
class Outcome:
    """What one training gave and cost."""

    metrics: dict[str, float]
    """Means over the test views: psnr (dB), ssim, flip, mean_color_deviation, composite_psnr, ..."""
    seconds: dict[str, float]
    """startup (photos, model), statistics (of the photos, for the overlay), training, evaluation."""
    gaussians: int
    """Number of Gaussians at the end."""
    peak_memory_mb: float
    """Largest memory that torch held on the GPU while training; on a CPU that of the process."""
    versions: dict[str, str] = field(default_factory=dict)
    """torch, gsplat, nerfstudio, and the device's name."""
    views: dict[str, dict[str, float]] = field(default_factory=dict)
    """Metrics of each test view by its file's name."""
    curve: list[dict[str, float]] = field(default_factory=list)
    """At the marks: step, seconds (statistics and training so far, evaluations not counted), gaussians, metrics."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


@no_event_writers_left()
def train_and_evaluate(
    config: SSATrainerConfig,
    on_step: Callable[[int], None] = lambda step: None,
    marks: tuple[int, ...] = (),
    test_scale: float | None = None,
    flip_processes: int = 1,
    region: ArtifactRegion | None = None,
) -> tuple[Outcome, SSAPipeline, Path]:
    """Train a configuration to its end and evaluate every test view.

    Args:
        on_step: called with the number of finished steps.
        marks: steps after which the test views are evaluated too, with the clock stopped.
        test_scale: test photos are resized by this, training photos by the configuration's own.
        flip_processes: processes that compare views by FLIP.
        region: where the photos' own artifact is; the test views' metrics are then taken inside and outside, too.

    Returns:
        The outcome, the trained pipeline, and the run's config.yml for `ns-eval`, `ns-export`, `ns-viewer`.

    Raises:
        Diverged: a Gaussian is not finite, none can be seen any more, or the guards gave the training up.
    """
    start = time.perf_counter()
    others = CONSOLE, rich.get_console()  # nerfstudio's messages, and its bars, of which a file gets empty lines
    former = [other.quiet for other in others]
    flips = FlipProcesses(flip_processes)
    try:
        for other in others:
            other.quiet = True
        begin_run(config)
        # Not in config.yml, which other commands load.
        config.pipeline._target, config.pipeline.datamanager._target = TimedPipeline, TimedDatamanager
        trainer: SSATrainer = set_up_trainer(config)
        pipeline = cast(TimedPipeline, trainer.pipeline)
        pipeline.read_photos(test_scale)
        judge = partial(evaluate, pipeline, flips, region)
        clock = StepClock(pipeline, config.max_num_iterations, marks, on_step, judge)
        after_each_step(trainer, clock.after_step)
        if clock.cuda:
            torch.cuda.reset_peak_memory_stats()
        setup = time.perf_counter() - start
        clock.start()
        _train(trainer)
        began = time.perf_counter()
        views = clock.views if config.max_num_iterations in marks else judge()
        evaluated = clock.paused + time.perf_counter() - began
    finally:
        flips.close()
        for other, quiet in zip(others, former, strict=True):
            other.quiet = quiet
    outcome = Outcome(
        metrics=mean_metrics(views),
        seconds={
            "startup": setup - pipeline.statistics_seconds,
            "statistics": pipeline.statistics_seconds,
            "training": clock.training,
            "evaluation": evaluated,
        },
        gaussians=pipeline.model.num_points,
        peak_memory_mb=clock.peak_memory_mb,
        versions=versions(),
        views=views,
        curve=clock.curve,
    )
    return outcome, pipeline, config.get_base_dir() / "config.yml"  # pyright: ignore[reportReturnType]


@torch.no_grad()
def evaluate(
    pipeline: SSAPipeline, flips: FlipProcesses, region: ArtifactRegion | None = None
) -> dict[str, dict[str, float]]:
    """Metrics of each test view by its file's name, with a region also inside and outside of it.

    Raises:
        Diverged: as `train_and_evaluate`.
    """
    _require_alive(pipeline.model)
    pipeline.eval()
    names = [path.name for path in pipeline.datamanager.eval_dataset.image_filenames]
    views, waiting = {}, {}
    for name, (camera, batch) in zip(names, pipeline.datamanager.fixed_indices_eval_dataloader, strict=True):
        outputs = pipeline.model.get_outputs_for_camera(camera)
        target = pipeline.model.target(outputs, batch)
        waiting[name] = flips.submit(outputs["rgb"], target)
        views[name] = view_metrics_without_flip(outputs, target)
        if region is not None:
            views[name] |= region.view_metrics(outputs, target)
    pipeline.train()
    return {name: {**views[name], "flip": flip.result()} for name, flip in waiting.items()}


def _train(trainer: SSATrainer) -> None:
    try:
        trainer.train()
    except TrainingError as error:
        if error.__cause__ is not None:  # the disk, not the numbers
            raise
        raise Diverged(error.problem, error.remedy) from error
    except (RuntimeError, ValueError, IndexError) as error:
        _require_alive(trainer.pipeline.model, error)
        raise


def _require_alive(model: SSASplatfactoModel, cause: Exception | None = None) -> None:
    for name, values in model.gauss_params.items():
        if not torch.isfinite(values).all():
            raise Diverged(f"{name} of a Gaussian is not finite") from cause
    if not (torch.sigmoid(model.opacities) > INVISIBLE).any():
        raise Diverged("no Gaussian can be seen any more") from cause
