"""What the guards cost: `python -m ssa_nerfstudio.benchmark.guards --data DIR`

Blocks of steps of one training take turns with and without, so that both draw the same Gaussians and a machine that
drifts drifts for both; the device is waited for between blocks only. The scene grows first and keeps its Gaussians
then. Prints the ratio of the times with its interval.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from ssa_nerfstudio.benchmark.run import configure, versions
from ssa_nerfstudio.errors import refuse
from ssa_nerfstudio.plugin.fused_adam import FusedAdam
from ssa_nerfstudio.plugin.guards import READ_EVERY
from ssa_nerfstudio.plugin.trainer import SSATrainer


@dataclass
class Command:
    """Measure the guards' cost."""

    data: Path
    """A nerfstudio dataset."""
    method: str = "ssa-splatfacto"
    """One of this plugin's methods."""
    overlay: str = "on"
    """on or off."""
    grow: int = 2_000
    """Steps of ordinary training before the first block."""
    pairs: int = 100
    """Pairs of blocks, one with guards and one without; the first two warm up."""
    block: int = READ_EVERY
    """Steps of a block: a multiple of those between two looks of the host, so that every block has as many."""
    scale_factor: float = 1.0
    """Photos are resized by this."""

    def run(self) -> None:
        """Train in turns and print one line."""
        if self.block % READ_EVERY or self.pairs < 3:
            raise refuse(f"--block must be a multiple of {READ_EVERY} and --pairs at least 3")
        with TemporaryDirectory() as folder:
            training = self._training(Path(folder))
            for _ in range(self.grow):
                training.step()
            times = np.array([self._pair(training, k) for k in range(self.pairs)])[2:]
        percent = 100 * (times[:, 1] / times[:, 0] - 1)
        draws = np.random.default_rng(0).choice(percent, (10_000, len(percent)))
        low, high = np.percentile(np.median(draws, axis=1), [2.5, 97.5])
        without = 1e3 * np.median(times[:, 0]) / self.block
        gaussians = training.trainer.pipeline.model.num_points
        print(
            f"{self.method}, overlay {self.overlay}, {gaussians} Gaussians, {versions()['device']}: {without:.3f} ms a "
            f"step without guards; with them {np.median(percent):+.2f} % (95 %: {low:+.2f} to {high:+.2f} %)"
        )

    def _pair(self, training: Training, pair: int) -> tuple[float, float]:
        """Seconds of a block without and of one with guards; the one that is first is so every other time."""
        first = bool(pair % 2)
        times = {first: self._time(training, first), (not first): self._time(training, not first)}
        return times[False], times[True]

    def _training(self, output: Path) -> Training:
        model = {"overlay": self.overlay, "num_downscales": 0, "stop_split_at": self.grow, "mcmc_stop_at": self.grow}
        steps = self.grow + 2 * self.pairs * self.block
        config = configure(self.method, self.data, output, steps, model, self.scale_factor)
        config.scale_schedules = False
        torch.manual_seed(0)
        config.set_timestamp()
        trainer: SSATrainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.pipeline.train()
        return Training(trainer)

    def _time(self, training: Training, guarded: bool) -> float:
        training.switch(guarded)
        _wait()
        start = time.perf_counter()
        for _ in range(self.block):
            training.step()
        _wait()
        return time.perf_counter() - start


class Training:
    """A training whose guards can be switched off and on as it goes."""

    def __init__(self, trainer: SSATrainer) -> None:
        self.trainer, self.steps = trainer, 0
        self._guard = trainer.optimizers.guard

    def switch(self, guarded: bool) -> None:
        """Do as from the start with `guards` in the configuration."""
        trainer, model = self.trainer, self.trainer.pipeline.model
        trainer.optimizers.guard = self._guard if guarded else None
        model.config.guards = model.strategy.guarded = guarded
        model.info = {}
        for optimizer in trainer.optimizers.optimizers.values():
            if isinstance(optimizer, FusedAdam):
                optimizer.refused = None

    def step(self) -> dict[str, torch.Tensor]:
        """Train one step, as nerfstudio's loop does: the terms of its loss."""
        for callback in self.trainer.callbacks:
            callback.run_callback_at_location(self.steps, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        _, losses, _ = self.trainer.train_iteration(self.steps)
        for callback in self.trainer.callbacks:
            callback.run_callback_at_location(self.steps, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        self.steps += 1
        return losses


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


if __name__ == "__main__":
    tyro.cli(Command).run()
