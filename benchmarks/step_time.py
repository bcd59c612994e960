"""Milliseconds of one training step, splatfacto's and ours: `python benchmarks/step_time.py --data DIR`

Full resolution, unscaled schedules, the whole body of nerfstudio's training loop, steps 700 to 1099 of one process; the
device is synchronized at both ends only. Run the methods in turn, several times: a machine drifts more than they
differ.
"""

from __future__ import annotations

import copy
import random
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils import writer

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.plugin.methods import METHODS

FIRST, LAST = 699, 1099
"""Steps between which the time is taken: after Triton's compilation and the first refinement, at step 600, which takes
150 ms to load its kernels."""


@dataclass
class Command:
    """Time the training steps of one method."""

    data: Path
    """A nerfstudio dataset."""
    method: Literal["splatfacto", "ssa-splatfacto", "ssa-splatfacto-mcmc", "ssa-splatfacto-paper"] = "ssa-splatfacto"
    """Method to time."""
    overlay: Literal["on", "off"] = "on"
    """Whether the method learns an overlay; splatfacto has none."""

    def run(self) -> None:
        """Train 1100 steps and print one line.

        Raises:
            InputError: the dataset cannot be trained on.
        """
        Transforms.read(self.data)
        config = copy.deepcopy((all_methods | METHODS)[self.method])
        config.vis, config.max_num_iterations, config.steps_per_save = "tensorboard", LAST + 1, 10 * LAST
        config.steps_per_eval_image = config.steps_per_eval_batch = config.steps_per_eval_all_images = 0
        config.logging.local_writer.enable = False
        config.output_dir = Path(tempfile.mkdtemp())
        config.data = config.pipeline.datamanager.data = self.data
        parser = NerfstudioDataParserConfig(load_3D_points=True, eval_mode="interval", eval_interval=8)
        config.pipeline.datamanager.dataparser = parser  # pyright: ignore[reportAttributeAccessIssue]
        model = config.pipeline.model
        model.num_downscales = 0  # pyright: ignore[reportAttributeAccessIssue]
        if self.method != "splatfacto":
            config.scale_schedules = False
            model.overlay = self.overlay  # pyright: ignore[reportAttributeAccessIssue]
        random.seed(config.machine.seed)
        np.random.seed(config.machine.seed)  # noqa: NPY002 - nerfstudio draws from numpy's global generator
        torch.manual_seed(config.machine.seed)
        config.set_timestamp()
        config.save_config()
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.config.viewer.quit_on_train_completion = True
        writer.EVENT_WRITERS.clear()  # tensorboard's; splatfacto's default, the viewer, has none
        times: dict[int, float] = {}

        def note(step: int) -> None:
            if step in (FIRST, LAST):
                if torch.cuda.is_available():
                    torch.cuda.synchronize()
                times[step] = time.perf_counter()

        trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], note))
        trainer.train()
        milliseconds = 1e3 * (times[LAST] - times[FIRST]) / (LAST - FIRST)
        print(
            f"{self.method} {self.overlay}: {milliseconds:.3f} ms a step, {trainer.pipeline.model.num_points} Gaussians"
        )


if __name__ == "__main__":
    run_script(Command)
