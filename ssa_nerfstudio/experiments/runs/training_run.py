"""One training through nerfstudio's own trainer, evaluated and timed: the one place here that starts it."""

from __future__ import annotations

import copy
import json
import random
import resource
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
import tyro
import yaml
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE

from ssa_nerfstudio.errors import TrainingError
from ssa_nerfstudio.experiments.runs.flip_processes import FlipProcesses
from ssa_nerfstudio.experiments.runs.machine import versions
from ssa_nerfstudio.plugin.datamanager import SSADatamanager
from ssa_nerfstudio.plugin.evaluation import view_metrics_without_flip
from ssa_nerfstudio.plugin.methods import ssa_splatfacto, ssa_splatfacto_mcmc, ssa_splatfacto_paper
from ssa_nerfstudio.plugin.model import SSASplatfactoModel, SSASplatfactoModelConfig
from ssa_nerfstudio.plugin.pipeline import SSAPipeline
from ssa_nerfstudio.plugin.trainer import SSATrainer, SSATrainerConfig

METHODS: dict[str, SSATrainerConfig] = {
    str(spec.config.method_name): cast(SSATrainerConfig, spec.config)
    for spec in (ssa_splatfacto, ssa_splatfacto_mcmc, ssa_splatfacto_paper)
}
"""The methods by name."""
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


def configure(
    method: str,
    data: Path,
    output: Path,
    steps: int,
    model: dict[str, Any] | None = None,
    scale_factor: float = 1.0,
    seed: int = 0,
) -> SSATrainerConfig:
    """A method's configuration for an unattended run: no viewer, no evaluation in between, one checkpoint at the end.

    Args:
        method: a key of `METHODS`.
        data: nerfstudio dataset; without named splits every 8th photo is held out.
        output: folder of the run (nerfstudio puts `<name>/<method>/<time>` below it).
        steps: number of training steps; schedules are scaled to it.
        model: values of the model's configuration by field name.
        scale_factor: photos are resized by this.
        seed: added to nerfstudio's own, of all random numbers and of the order of the views.
    """
    config = copy.deepcopy(METHODS[method])
    config.vis = "tensorboard"
    config.logging.local_writer.enable = False
    config.data, config.output_dir, config.max_num_iterations = data, output, steps
    config.steps_per_save = steps + 1
    config.steps_per_eval_image = 0
    config.machine.seed += seed
    datamanager = config.pipeline.datamanager
    datamanager.data, datamanager.camera_res_scale_factor = data, scale_factor
    datamanager.train_cameras_sampling_seed += seed
    datamanager.dataparser = NerfstudioDataParserConfig(load_3D_points=True, eval_mode="interval", eval_interval=8)
    for name, value in (model or {}).items():
        if not hasattr(config.pipeline.model, name):
            raise AttributeError(f"the model has no setting {name!r}")
        setattr(config.pipeline.model, name, value)
    return config


def train_and_evaluate(
    config: SSATrainerConfig,
    on_step: Callable[[int], None] = lambda step: None,
    marks: tuple[int, ...] = (),
    test_scale: float | None = None,
    flip_processes: int = 1,
) -> tuple[Outcome, SSAPipeline, Path]:
    """Train a configuration to its end and evaluate every test view.

    Args:
        on_step: called with the number of finished steps.
        marks: steps after which the test views are evaluated too, with the clock stopped.
        test_scale: test photos are resized by this, training photos by the configuration's own.
        flip_processes: processes that compare views by FLIP.

    Returns:
        The outcome, the trained pipeline, and the run's config.yml for `ns-eval`, `ns-export`, `ns-viewer`.

    Raises:
        Diverged: a Gaussian is not finite, none can be seen any more, or the guards gave the training up.
    """
    start = time.perf_counter()
    seed = config.machine.seed
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - nerfstudio draws from numpy's global generator
    torch.manual_seed(seed)
    config.set_timestamp()
    quiet, CONSOLE.quiet = CONSOLE.quiet, True
    flips = FlipProcesses(flip_processes)
    try:
        config.save_config()
        # Not in config.yml, which other commands load.
        config.pipeline._target, config.pipeline.datamanager._target = _TimedPipeline, _TimedDatamanager
        trainer: SSATrainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        writer.EVENT_WRITERS.clear()  # nobody reads them, and the viewer that they stand in for has none
        pipeline = cast(_TimedPipeline, trainer.pipeline)
        pipeline.read_photos(test_scale)
        judge = partial(evaluate, pipeline, flips)
        clock = _Clock(pipeline, config.max_num_iterations, marks, on_step, judge)
        trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], clock.after_step))
        if clock.cuda:
            torch.cuda.reset_peak_memory_stats()
        trainer.config.viewer.quit_on_train_completion = True
        setup = time.perf_counter() - start
        clock.start()
        _train(trainer)
        began = time.perf_counter()
        views = clock.views if config.max_num_iterations in marks else judge()
        evaluated = clock.paused + time.perf_counter() - began
    finally:
        flips.close()
        CONSOLE.quiet = quiet
        # nerfstudio keeps its event writers in globals: the next run in this process starts with none.
        writer.EVENT_WRITERS.clear()
        writer.EVENT_STORAGE.clear()
        writer.GLOBAL_BUFFER.clear()
    outcome = Outcome(
        metrics=mean(views),
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
def evaluate(pipeline: SSAPipeline, flips: FlipProcesses) -> dict[str, dict[str, float]]:
    """Metrics of each test view by its file's name.

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
    pipeline.train()
    return {name: {**views[name], "flip": flip.result()} for name, flip in waiting.items()}


def mean(views: dict[str, dict[str, float]]) -> dict[str, float]:
    """Mean over the views of every metric."""
    names = next(iter(views.values()))
    return {name: sum(view[name] for view in views.values()) / len(views) for name in names}


class _TimedDatamanager(SSADatamanager):
    """A datamanager that tells what decoding and undistorting took."""

    photo_seconds = 0.0

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]):
        start = time.perf_counter()
        photos = super()._load_images(split, cache_images_device)
        self.photo_seconds += time.perf_counter() - start
        return photos


class _TimedPipeline(SSAPipeline):
    """A pipeline that tells what the overlay's statistics took, without decoding the photos."""

    statistics_seconds = 0.0

    def _set_overlays(self) -> None:
        start = time.perf_counter()
        super()._set_overlays()
        # The photos may have been decoded meanwhile.
        self.statistics_seconds = time.perf_counter() - start - cast(_TimedDatamanager, self.datamanager).photo_seconds

    def read_photos(self, test_scale: float | None) -> None:
        """Decode the training photos, which nothing may have asked for yet; choose the test photos' size."""
        _ = self.datamanager.cached_train
        if test_scale is not None and test_scale != self.datamanager.config.camera_res_scale_factor:
            self.datamanager.config.camera_res_scale_factor = test_scale
            self.datamanager.eval_dataset = self.datamanager.create_eval_dataset()


class _Clock:
    """Seconds of training, stopped while test views are evaluated."""

    def __init__(
        self,
        pipeline: _TimedPipeline,
        steps: int,
        marks: tuple[int, ...],
        on_step: Callable[[int], None],
        judge: Callable[[], dict[str, dict[str, float]]],
    ) -> None:
        self.cuda = pipeline.model.device.type == "cuda"
        self.training = self.paused = self.peak_memory_mb = 0.0
        self.curve: list[dict[str, float]] = []
        self.views: dict[str, dict[str, float]] = {}
        self._pipeline, self._steps, self._marks = pipeline, steps, set(marks)
        self._on_step, self._judge = on_step, judge

    def start(self) -> None:
        """Start counting."""
        self._began = self._now()

    def after_step(self, step: int) -> None:
        """What happens after every training step, given its number from 0."""
        done = step + 1
        self._on_step(done)
        if done != self._steps and done not in self._marks:
            return
        stopped = self._now()
        self.training = stopped - self._began - self.paused
        if self.cuda:
            self.peak_memory_mb = torch.cuda.max_memory_allocated() / 2**20
        else:
            self.peak_memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
        if done in self._marks:
            self.views = self._judge()
            seconds = self._pipeline.statistics_seconds + self.training
            gaussians = self._pipeline.model.num_points
            self.curve.append({"step": done, "seconds": seconds, "gaussians": gaussians, **mean(self.views)})
            self.paused += self._now() - stopped

    def _now(self) -> float:
        if self.cuda:
            torch.cuda.synchronize()
        return time.perf_counter()


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


def model_settings(settings: tuple[str, ...]) -> dict[str, Any]:
    """Settings of the model by field name, from name=value."""
    usual, model = SSASplatfactoModelConfig(), {}
    for name, value in (setting.split("=", 1) for setting in settings):
        model[name] = yaml.safe_load(value)
        if isinstance(model[name], bool) and isinstance(getattr(usual, name, None), str):
            model[name] = value.lower()  # YAML reads on and off as booleans
    if "overlay_given" in model:
        model["overlay_given"] = Path(model["overlay_given"])
    return model


@dataclass
class Command:
    """Train once and write the metrics as JSON: `python -m ssa_nerfstudio.experiments.runs.training_run`."""

    data: Path
    """A nerfstudio dataset."""
    output: Path
    """The JSON file to write; the trained model goes into a folder beside it."""
    method: str = "ssa-splatfacto"
    """ssa-splatfacto, ssa-splatfacto-mcmc or ssa-splatfacto-paper."""
    steps: int = 30_000
    """Training steps; every schedule is scaled to them."""
    settings: tuple[str, ...] = ()
    """Settings of the model as name=value, for example overlay=off sparsity_weight=0.01."""
    scale_factor: float = 1.0
    """Photos are resized by this."""

    def run(self) -> None:
        """Train, evaluate, write."""
        folder = self.output.with_suffix("")
        model = model_settings(self.settings)
        config = configure(self.method, self.data, folder, self.steps, model, self.scale_factor)
        outcome, _, path = train_and_evaluate(config)
        asked = {"method": self.method, "data": self.data.name, "steps": self.steps, "settings": list(self.settings)}
        self.output.parent.mkdir(parents=True, exist_ok=True)
        self.output.write_text(json.dumps({**asked, **outcome.as_dict(), "config": str(path)}, indent=2) + "\n")


if __name__ == "__main__":
    tyro.cli(Command).run()
