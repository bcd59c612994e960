"""Seconds until photos behind an artifact give as good a scene as clean ones: `python benchmarks/time_to_quality.py`

nerfstudio's splatfacto trains on the clean photos with its own settings, then this plugin's methods on the photos with
the artifact, one after another on one device. What is wanted is splatfacto's PSNR less 0.1 dB, on the same clean test
views. The photos are decoded and the model is set up before a clock starts; evaluation comes after it has stopped. The
overlay's statistics count.
"""

from __future__ import annotations

import copy
import json
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import torch

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, Method, NotNegative, file_to_write
from ssa_nerfstudio.data.training_requirements import check_training
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.runs.result_lines import read_lines

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

TOLERANCE = 0.1
"""dB below splatfacto's PSNR that count as reached."""


@dataclass
class Command:
    """Time splatfacto on clean photos, and this plugin's methods on the same photos behind an artifact."""

    clean: Path
    """A nerfstudio dataset without an artifact."""
    data: Path
    """The same dataset with an artifact in front of its training photos, and clean test photos."""
    output: Annotated[Path, file_to_write()]
    """File to which every training is added, as a line of JSON. What it has, by the name of the dataset's folder, is
    not trained again: choose another for another machine or revision."""
    methods: tuple[Method, ...] = ("ssa-splatfacto-fast", "ssa-splatfacto")
    """Methods that train behind the artifact, each with as many steps as it has."""
    steps: Count = 30_000
    """Steps of splatfacto's training."""
    seeds: tuple[NotNegative, ...] = (0, 1)
    """Seeds: rounds in which all methods are trained in turn."""

    def run(self) -> None:
        """Train what the file does not have yet, and print a line for each training.

        Raises:
            InputError: a dataset cannot be trained on, there is no CUDA, or the file holds something else.
        """
        for path in (self.clean, self.data):
            check_training(Transforms.read(path))
        lines = read_lines(self.output, ("method", "data", "steps", "seed"), since="psnr")
        for seed in self.seeds:
            bar = self._line(lines, "splatfacto", self.clean, seed)
            _print(bar, bar)
            for method in self.methods:
                _print(self._line(lines, method, self.data, seed), bar)

    def _line(self, lines: list[dict[str, Any]], method: str, data: Path, seed: int) -> dict[str, Any]:
        """Of the file, or of a training that is added to it."""
        from ssa_nerfstudio.plugin.methods import METHODS

        steps = METHODS[method].max_num_iterations if method in METHODS else self.steps
        asked = {"method": method, "data": data.name, "steps": steps, "seed": seed}
        for line in lines:
            if asked.items() <= line.items():
                return line
        if not torch.cuda.is_available():
            raise InputError("there is no CUDA, without which splatfacto cannot train", "run this on a GPU")
        with TemporaryDirectory() as folder:
            found = (_ours if method in METHODS else _splatfacto)(method, data, Path(folder), steps, seed)
        self.output.parent.mkdir(parents=True, exist_ok=True)
        with self.output.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asked | found) + "\n")
        return asked | found


def _ours(method: str, data: Path, folder: Path, steps: int, seed: int) -> dict[str, Any]:
    """Train one of this plugin's methods."""
    from ssa_nerfstudio.experiments.runs.run_configuration import configure
    from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate

    outcome, _, _ = train_and_evaluate(configure(method, data, folder, steps, seed=seed))
    return {
        "psnr": outcome.metrics["psnr"],
        "seconds": outcome.seconds["statistics"] + outcome.seconds["training"],
        "statistics": outcome.seconds["statistics"],
        "gaussians": outcome.gaussians,
        "views": {name: values["psnr"] for name, values in outcome.views.items()},
        "versions": outcome.versions,
    }


def _splatfacto(method: str, data: Path, folder: Path, steps: int, seed: int) -> dict[str, Any]:
    """Train nerfstudio's own method."""
    from ssa_nerfstudio.experiments.runs.machine import versions
    from ssa_nerfstudio.experiments.runs.prepared_trainer import prepared_trainer
    from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left
    from ssa_nerfstudio.plugin.training.step_callbacks import after_each_step

    with no_event_writers_left():
        trainer = prepared_trainer(_configuration(method, data, folder, steps, seed))
        _ = trainer.pipeline.datamanager.cached_train
        ended = 0.0

        def note(step: int) -> None:
            nonlocal ended
            if step == steps - 1:
                torch.cuda.synchronize()
                ended = time.perf_counter()

        after_each_step(trainer, note)
        torch.cuda.synchronize()
        began = time.perf_counter()
        trainer.train()
    views = _psnr(trainer.pipeline)
    return {
        "psnr": sum(views.values()) / len(views),
        "seconds": ended - began,
        "gaussians": trainer.pipeline.model.num_points,
        "views": views,
        "versions": versions(),
    }


def _configuration(method: str, data: Path, folder: Path, steps: int, seed: int) -> TrainerConfig:
    """nerfstudio's own settings, without a viewer and without evaluation in between."""
    from nerfstudio.configs.method_configs import all_methods

    from ssa_nerfstudio.experiments.runs.run_configuration import leave_unattended

    config = copy.deepcopy(all_methods[method])
    leave_unattended(config, data, folder, steps)
    config.machine.seed += seed
    return config


@torch.no_grad()
def _psnr(pipeline: Any) -> dict[str, float]:
    """PSNR of each test view by its file's name."""
    from ssa_nerfstudio.metrics.image import psnr

    pipeline.eval()
    model, manager = pipeline.model, pipeline.datamanager
    names = [path.name for path in manager.eval_dataset.image_filenames]
    values = {}
    for name, (camera, batch) in zip(names, manager.fixed_indices_eval_dataloader, strict=True):
        outputs = model.get_outputs_for_camera(camera)
        target = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
        values[name] = psnr(outputs["rgb"], target)
    return values


def _print(line: dict[str, Any], bar: dict[str, Any]) -> None:
    """PSNR and seconds of a training, and what they are beside splatfacto's."""
    text = f"{line['method']}, {line['data']}, {line['steps']} steps, seed {line['seed']}: "
    text += f"{line['psnr']:.2f} dB in {line['seconds']:.1f} s"
    if line is not bar:
        above = line["psnr"] - (bar["psnr"] - TOLERANCE)
        text += f", {line['seconds'] / bar['seconds']:.3f} of splatfacto's; {above:+.2f} dB against what is wanted"
    print(text, flush=True)


if __name__ == "__main__":
    run_script(Command)
