"""Milliseconds of a step with gsplat's lists of tiles and with ours: `python benchmarks/tile_list_time.py --data DIR`

The default's first steps, as long as MCMC takes to reach its largest number of Gaussians. From step 1500 on each
hundred steps use the other lists; the device is synchronized in between. Needs CUDA.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.runs.prepared_trainer import no_event_writers_left, prepared_trainer
from ssa_nerfstudio.experiments.runs.run_configuration import configure
from ssa_nerfstudio.plugin.training.schedules import DEFAULT_LENGTH
from ssa_nerfstudio.rasterization import cuda, tile_lists

FIRST, TURN = 1500, 100


@dataclass
class Command:
    """Time training steps with both kinds of lists in turn."""

    data: Path
    """A nerfstudio dataset."""
    strategy: Literal["mcmc", "adc"] = "mcmc"
    """Densification."""
    steps: int = 4000
    """Steps to train, of the default's."""

    def run(self) -> None:
        """Train, and print a line for each kind of lists and one for refinements.

        Raises:
            InputError: the dataset cannot be trained on, or there is no CUDA.
        """
        Transforms.read(self.data)
        if not torch.cuda.is_available():
            raise InputError("there is no CUDA", "a CPU's rasterizer has lists of its own")
        settings = {"strategy": self.strategy, "overlay": "on"}
        with TemporaryDirectory() as folder, no_event_writers_left():
            config = configure("ssa-splatfacto", self.data, Path(folder), DEFAULT_LENGTH, settings)
            trainer = prepared_trainer(config)
            trainer.config.max_num_iterations = self.steps
            self._time(trainer)

    def _time(self, trainer: Any) -> None:
        model = trainer.pipeline.model
        turns: dict[bool, list[str]] = {False: [], True: []}
        entries: dict[bool, int] = {}
        refined, began, plain = [], [0.0], cuda.tile_lists

        def counted(*given):
            offsets, ids = plain(*given)
            entries[tile_lists._TRITON] = len(ids)
            return offsets, ids

        def note(step: int) -> None:
            if step >= FIRST and step % TURN == TURN - 1:
                torch.cuda.synchronize()
                if began[0]:
                    spent = 1e3 * (time.perf_counter() - began[0]) / TURN
                    turns[tile_lists._TRITON].append(f"{spent:.2f} ({model.num_points:,})")
                tile_lists._TRITON = not tile_lists._TRITON
                began[0] = time.perf_counter()

        def refine(*, step: int, **given) -> None:
            due = step >= FIRST and step % model.strategy.refine_every == 0
            if due:
                torch.cuda.synchronize()
            before = time.perf_counter()
            post_backward(step=step, **given)
            if due:
                torch.cuda.synchronize()
                refined.append(1e3 * (time.perf_counter() - before))

        post_backward, model.strategy.step_post_backward = model.strategy.step_post_backward, refine
        cuda.tile_lists = counted
        trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], note))
        trainer.train()
        for ours, found in turns.items():
            print(f"{'our' if ours else 'gsplat'} lists, ms a step (Gaussians): {', '.join(found)}")
            print(f"  entries in the last view: {entries[ours]:,}")
        print(f"a refinement: {sum(refined) / max(1, len(refined)):.1f} ms")


if __name__ == "__main__":
    run_script(Command)
