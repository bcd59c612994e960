"""Milliseconds of a step with gsplat's lists of tiles and with ours: `python benchmarks/tile_list_time.py --data DIR`

The default's first steps, as long as MCMC takes to reach its largest number of Gaussians. From step 1600 on each
hundred steps use the other lists, gsplat's first. The device's own clock tells the times, and nothing waits for it.
Needs CUDA and Triton.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.runs.lap import Lap
from ssa_nerfstudio.rasterization import cuda, tile_lists

FIRST, TURN = 1600, 100
"""The first step of the first turn, and the steps of each."""
LEAST = FIRST + 2 * TURN
"""Steps of a training in which both kinds of lists have a turn."""


@dataclass
class Command:
    """Time training steps with both kinds of lists in turn."""

    data: Path
    """A nerfstudio dataset."""
    strategy: Literal["mcmc", "adc"] = "mcmc"
    """Densification."""
    steps: int = 4000
    """Steps to train, of the default's; at least 1800."""

    def run(self) -> None:
        """Train, and print a line for each kind of lists and one for refinements.

        Raises:
            InputError: there are too few steps for a turn of each kind, the dataset cannot be trained on, or CUDA or
                Triton is missing.
        """
        if self.steps < LEAST:
            raise InputError(f"--steps must be at least {LEAST}, so that both lists have a turn, got {self.steps}")
        Transforms.read(self.data)
        if not torch.cuda.is_available():
            raise InputError("there is no CUDA", "a CPU's rasterizer has lists of its own")
        if not tile_lists._TRITON:
            raise InputError("our lists need Triton, which is not installed", "pip install triton")
        from ssa_nerfstudio.experiments.runs.prepared_trainer import prepared_trainer
        from ssa_nerfstudio.experiments.runs.run_configuration import configure
        from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left
        from ssa_nerfstudio.plugin.training.schedules import DEFAULT_LENGTH

        settings = {"strategy": self.strategy, "overlay": "on"}
        with TemporaryDirectory() as folder, no_event_writers_left():
            config = configure("ssa-splatfacto", self.data, Path(folder), DEFAULT_LENGTH, settings)
            trainer = prepared_trainer(config)
            trainer.config.max_num_iterations = self.steps
            self._time(trainer)

    def _time(self, trainer: Any) -> None:
        from ssa_nerfstudio.plugin.training.step_callbacks import after_each_step

        model = trainer.pipeline.model
        turns: dict[bool, list[tuple[Lap, int]]] = {False: [], True: []}
        entries: dict[bool, int] = {}
        refinements: list[Lap] = []
        running: list[Lap] = []
        plain, post_backward = cuda.tile_lists, model.strategy.step_post_backward

        def counted(*given):
            offsets, ids = plain(*given)
            entries[tile_lists._TRITON] = len(ids)
            return offsets, ids

        def note(step: int) -> None:
            if step + 1 < FIRST or (step + 1 - FIRST) % TURN:
                return
            if running:
                lap = running.pop()
                lap.end()
                turns[tile_lists._TRITON].append((lap, model.num_points))
            tile_lists._TRITON = not tile_lists._TRITON
            running.append(Lap())

        def refine(**given) -> None:
            lap = Lap()
            post_backward(**given)
            lap.end()
            if given["step"] >= FIRST and given["step"] % model.strategy.refine_every == 0:
                refinements.append(lap)

        cuda.tile_lists, model.strategy.step_post_backward = counted, refine
        after_each_step(trainer, note)
        trainer.train()
        for ours, found in turns.items():
            each = (f"{1e3 * lap.seconds() / TURN:.2f} ({gaussians:,})" for lap, gaussians in found)
            print(f"{'our' if ours else 'gsplat'} lists, ms a step (Gaussians): {', '.join(each)}")
            print(f"  entries in the last view: {entries[ours]:,}")
        print(f"a refinement: {1e3 * sum(lap.seconds() for lap in refinements) / max(1, len(refinements)):.1f} ms")


if __name__ == "__main__":
    run_script(Command)
