"""What the guards cost: `python -m ssa_nerfstudio.benchmark.guards --data DIR`

Two trainings of one process, with and without, take turns at blocks of steps, so that a machine that drifts drifts for
both; the device is waited for between blocks only. Neither densifies: they draw the start points to the end, which are
few, so that what the guards add weighs most. Prints the ratio of the times with its 95 % interval.
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
    blocks: int = 40
    """Blocks of steps of each training; the first two warm up."""
    block: int = 50
    """Steps of a block."""
    scale_factor: float = 1.0
    """Photos are resized by this."""

    def run(self) -> None:
        """Train in turns and print one line."""
        with TemporaryDirectory() as folder:
            trainers = [self._trainer(Path(folder) / str(guards), guards) for guards in (False, True)]
            times = np.array([self._in_turn(trainers, b) for b in range(self.blocks)])[2:]
        percent = 100 * (times[:, 1] / times[:, 0] - 1)
        draws = np.random.default_rng(0).choice(percent, (10_000, len(percent)))
        low, high = np.percentile(np.median(draws, axis=1), [2.5, 97.5])
        without = 1e3 * np.median(times[:, 0]) / self.block
        print(
            f"{self.method}, overlay {self.overlay}, {versions()['device']}: {without:.3f} ms a step without guards; "
            f"with them {np.median(percent):+.2f} % (95 %: {low:+.2f} to {high:+.2f} %)"
        )

    def _in_turn(self, trainers: list[SSATrainer], block: int) -> list[float]:
        """Seconds of a block of both trainings; the one that is first is so every other time."""
        first = block % 2
        times = [self._time(trainers[k], block) for k in (first, 1 - first)]
        return [times[first], times[1 - first]]

    def _trainer(self, output: Path, guards: bool) -> SSATrainer:
        # Without densification, which is random, both draw as many Gaussians.
        model = {"overlay": self.overlay, "guards": guards, "num_downscales": 0, "stop_split_at": 0, "mcmc_stop_at": 0}
        config = configure(self.method, self.data, output, self.blocks * self.block, model, self.scale_factor)
        config.scale_schedules = False
        torch.manual_seed(0)
        config.set_timestamp()
        trainer: SSATrainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.pipeline.train()
        return trainer

    def _time(self, trainer: SSATrainer, block: int) -> float:
        _wait()
        start = time.perf_counter()
        for step in range(block * self.block, (block + 1) * self.block):
            for callback in trainer.callbacks:
                callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
            trainer.train_iteration(step)
            for callback in trainer.callbacks:
                callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        _wait()
        return time.perf_counter() - start


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


if __name__ == "__main__":
    tyro.cli(Command).run()
