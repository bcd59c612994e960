"""Cost of the guards against values that are not finite: `python benchmarks/guard_cost.py --data DIR`

One training takes every step number twice, with guards and without, in short blocks that take turns: both draw the same
Gaussians, and a machine that drifts drifts for both. The scene grows first and keeps its Gaussians then. Nothing waits
for the device between blocks; its own clock tells the times. Prints their ratio with its interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import torch

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Factor, Method, NotNegative, at_least
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.report.bootstrap import percent_change
from ssa_nerfstudio.experiments.runs.lap import Lap
from ssa_nerfstudio.experiments.runs.machine import versions
from ssa_nerfstudio.plugin.training.nonfinite import CHECK_EVERY

if TYPE_CHECKING:
    from ssa_nerfstudio.plugin.trainer import SSATrainer


@dataclass
class Command:
    """Measure the guards' cost."""

    data: Path
    """A nerfstudio dataset."""
    method: Method = "ssa-splatfacto"
    """Method to train with."""
    overlay: Literal["on", "off"] = "on"
    """Whether the method learns an overlay."""
    grow: NotNegative = 2_000
    """Steps of ordinary training before the first block."""
    pairs: Annotated[int, at_least(4)] = 100
    """So many times as many steps as lie between two checks by the host; the first two warm up."""
    block: int = 10
    """Steps before the other takes its turn."""
    scale_factor: Factor = 1.0
    """Photos are resized by this."""

    def run(self) -> None:
        """Train in turns and print one line.

        Raises:
            InputError: an option is out of range, or the dataset cannot be trained on.
        """
        if self.block < 1 or CHECK_EVERY % self.block:
            raise InputError(f"--block must divide {CHECK_EVERY}, got {self.block}")
        Transforms.read(self.data)
        from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left

        with TemporaryDirectory() as folder, no_event_writers_left():
            training = self._training(Path(folder))
            for _ in range(self.grow):
                training.step()
            times = np.array([self._pair(training, k) for k in range(self.pairs)])[2:]
        without = 1e3 * np.median(times[:, 0]) / CHECK_EVERY
        gaussians = training.trainer.pipeline.model.num_points
        print(
            f"{self.method}, overlay {self.overlay}, {gaussians} Gaussians, {versions()['device']}: {without:.3f} ms a "
            f"step without guards; with them {percent_change(times[:, 1], times[:, 0])}"
        )

    def _pair(self, training: Training, pair: int) -> list[float]:
        """Seconds of `CHECK_EVERY` steps without guards, and of the same with."""
        laps: dict[bool, list[Lap]] = {False: [], True: []}
        for block in range(CHECK_EVERY // self.block):
            begin = training.steps
            first = bool((pair + block) % 2)
            for guarded in (first, not first):
                training.steps = begin
                training.switch(guarded)
                lap = Lap()
                for _ in range(self.block):
                    training.step()
                lap.end()
                laps[guarded].append(lap)
        return [sum(lap.seconds() for lap in laps[guarded]) for guarded in (False, True)]

    def _training(self, output: Path) -> Training:
        from ssa_nerfstudio.experiments.runs.prepared_trainer import prepared_trainer
        from ssa_nerfstudio.experiments.runs.run_configuration import configure

        model = {"overlay": self.overlay, "num_downscales": 0, "stop_split_at": self.grow, "mcmc_stop_at": self.grow}
        model["strategy"] = "mcmc" if self.method.endswith("mcmc") else "adc"
        steps = self.grow + self.pairs * CHECK_EVERY
        config = configure(self.method, self.data, output, steps, model, self.scale_factor)
        config.scale_schedules = False
        trainer: SSATrainer = prepared_trainer(config)
        trainer.pipeline.train()
        return Training(trainer)


class Training:
    """A training whose guards can be switched off and on as it goes."""

    def __init__(self, trainer: SSATrainer) -> None:
        from nerfstudio.engine.callbacks import TrainingCallbackLocation

        self.trainer, self.steps = trainer, 0
        self._before = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION
        self._after = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
        self._guard = trainer.optimizers.guard

    def switch(self, guarded: bool) -> None:
        """Do as from the start with `guards` in the configuration."""
        trainer, model = self.trainer, self.trainer.pipeline.model
        trainer.optimizers.guard = self._guard if guarded else None
        model.config.guards = model.strategy.guarded = guarded
        model.info = {}

    def step(self) -> dict[str, torch.Tensor]:
        """Train one step, as nerfstudio's loop does: the terms of its loss."""
        for callback in self.trainer.callbacks:
            callback.run_callback_at_location(self.steps, self._before)
        _, losses, _ = self.trainer.train_iteration(self.steps)
        for callback in self.trainer.callbacks:
            callback.run_callback_at_location(self.steps, self._after)
        self.steps += 1
        return losses


if __name__ == "__main__":
    run_script(Command)
