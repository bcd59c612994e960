"""One training through nerfstudio's own trainer, evaluated and timed: the one place here that starts it."""

from __future__ import annotations

import copy
import json
import random
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import tyro
import yaml
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE

from ssa_nerfstudio.plugin.methods import ssa_splatfacto, ssa_splatfacto_mcmc, ssa_splatfacto_paper
from ssa_nerfstudio.plugin.pipeline import SSAPipeline
from ssa_nerfstudio.plugin.trainer import SSATrainer, SSATrainerConfig

METHODS: dict[str, SSATrainerConfig] = {
    str(spec.config.method_name): cast(SSATrainerConfig, spec.config)
    for spec in (ssa_splatfacto, ssa_splatfacto_mcmc, ssa_splatfacto_paper)
}
"""The methods by name."""


@dataclass
class Outcome:
    """What one training gave and cost."""

    metrics: dict[str, float]
    """Means over the test views: psnr (dB), ssim, flip, mean_colour_deviation, composite_psnr, ..."""
    seconds: dict[str, float]
    """startup (imports apart: photos, statistics, model), training, evaluation."""
    gaussians: int
    """Number of Gaussians at the end."""
    peak_memory_mb: float
    """Largest memory that torch held on the GPU; 0 on a CPU."""
    versions: dict[str, str] = field(default_factory=dict)
    """torch, gsplat, nerfstudio, and the device's name."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def configure(
    method: str, data: Path, output: Path, steps: int, model: dict[str, Any] | None = None, scale_factor: float = 1.0
) -> SSATrainerConfig:
    """A method's configuration for an unattended run: no viewer, no evaluation in between, one checkpoint at the end.

    Args:
        method: a key of `METHODS`.
        data: nerfstudio dataset; without named splits every 8th photo is held out.
        output: folder of the run (nerfstudio puts `<name>/<method>/<time>` below it).
        steps: number of training steps; schedules are scaled to it.
        model: values of the model's configuration by field name.
        scale_factor: photos are resized by this.
    """
    config = copy.deepcopy(METHODS[method])
    config.vis = "tensorboard"
    config.logging.local_writer.enable = False
    config.data, config.output_dir, config.max_num_iterations = data, output, steps
    config.steps_per_save = steps + 1
    config.steps_per_eval_image = 0
    datamanager = config.pipeline.datamanager
    datamanager.data, datamanager.camera_res_scale_factor = data, scale_factor
    datamanager.dataparser = NerfstudioDataParserConfig(load_3D_points=True, eval_mode="interval", eval_interval=8)
    for name, value in (model or {}).items():
        if not hasattr(config.pipeline.model, name):
            raise AttributeError(f"the model has no setting {name!r}")
        setattr(config.pipeline.model, name, value)
    return config


def train_and_evaluate(
    config: SSATrainerConfig, on_step: Callable[[int], None] = lambda step: None
) -> tuple[Outcome, SSAPipeline, Path]:
    """Train a configuration to its end and evaluate every test view.

    Args:
        on_step: called with the number of finished steps.

    Returns:
        The outcome, the trained pipeline, and the run's config.yml for `ns-eval`, `ns-export`, `ns-viewer`.
    """
    start = time.perf_counter()
    seed = config.machine.seed
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - nerfstudio draws from numpy's global generator
    torch.manual_seed(seed)
    config.set_timestamp()
    quiet, CONSOLE.quiet = CONSOLE.quiet, True
    try:
        config.save_config()
        trainer: SSATrainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.callbacks.append(
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], lambda step: on_step(step + 1))
        )
        cuda = trainer.device.startswith("cuda")
        if cuda:
            torch.cuda.reset_peak_memory_stats()
            torch.cuda.synchronize()
        ready = time.perf_counter()
        trainer.config.viewer.quit_on_train_completion = True
        trainer.train()
        if cuda:
            torch.cuda.synchronize()
        trained = time.perf_counter()
        pipeline = trainer.pipeline
        metrics = pipeline.get_average_eval_image_metrics()
        evaluated = time.perf_counter()
    finally:
        CONSOLE.quiet = quiet
        # nerfstudio keeps its event writers in globals: the next run in this process starts with none.
        writer.EVENT_WRITERS.clear()
        writer.EVENT_STORAGE.clear()
        writer.GLOBAL_BUFFER.clear()
    outcome = Outcome(
        metrics={name: value for name, value in metrics.items() if name not in ("num_rays_per_sec", "fps")},
        seconds={"startup": ready - start, "training": trained - ready, "evaluation": evaluated - trained},
        gaussians=pipeline.model.num_points,
        peak_memory_mb=torch.cuda.max_memory_allocated() / 2**20 if cuda else 0.0,
        versions=versions(),
    )
    return outcome, pipeline, config.get_base_dir() / "config.yml"  # pyright: ignore[reportReturnType]


def versions() -> dict[str, str]:
    """Versions of what a result depends on, and the device."""
    found = {name: version(name) for name in ("torch", "gsplat", "nerfstudio")}
    found["device"] = (
        torch.cuda.get_device_name() if torch.cuda.is_available() else f"CPU, {torch.get_num_threads()} threads"
    )
    return found


@dataclass
class Command:
    """One training, its figures written as JSON: `python -m ssa_nerfstudio.benchmark.run --data DIR --output FILE`."""

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
        model = {name: yaml.safe_load(value) for name, value in (s.split("=", 1) for s in self.settings)}
        # YAML reads on and off as booleans.
        if isinstance(model.get("overlay"), bool):
            model["overlay"] = "on" if model["overlay"] else "off"
        if "overlay_given" in model:
            model["overlay_given"] = Path(model["overlay_given"])
        folder = self.output.with_suffix("")
        config = configure(self.method, self.data, folder, self.steps, model, self.scale_factor)
        outcome, _, path = train_and_evaluate(config)
        asked = {"method": self.method, "data": self.data.name, "steps": self.steps, "settings": list(self.settings)}
        self.output.parent.mkdir(parents=True, exist_ok=True)
        self.output.write_text(json.dumps({**asked, **outcome.as_dict(), "config": str(path)}, indent=2) + "\n")


if __name__ == "__main__":
    tyro.cli(Command).run()
