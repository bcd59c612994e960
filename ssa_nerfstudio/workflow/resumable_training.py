"""A training without a viewer that continues from its newest checkpoint, and the pipeline that it leaves behind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import cast

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.pipeline import SSAPipeline
from ssa_nerfstudio.plugin.trainer import SSATrainer, SSATrainerConfig
from ssa_nerfstudio.plugin.training.checkpoints import load_pipeline_state, newest_first, step_of
from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left
from ssa_nerfstudio.plugin.training.random_numbers import seed_all
from ssa_nerfstudio.plugin.training.step_callbacks import after_each_step
from ssa_nerfstudio.sfm.progress_display import ProgressCallback


def config_file(config: SSATrainerConfig) -> Path:
    """The run's config.yml, which `ns-viewer`, `ns-eval` and the exports take."""
    return config.get_base_dir() / "config.yml"


@no_event_writers_left()
def train(
    config: SSATrainerConfig, on_progress: ProgressCallback, on_start: Callable[[Artifacts], None] = lambda _: None
) -> int:
    """Train up to the configuration's number of steps, from the newest checkpoint where there is one.

    Args:
        config: of a run whose folder has no time in its name, or a repeated call would start another one.
        on_progress: called after every step.
        on_start: called before the first step with the overlays.

    Returns:
        The step that it began at: 0, unless an earlier call left a checkpoint.

    Raises:
        SSAError: the input cannot be used, or the training cannot continue.
    """
    seed_all(config.machine.seed)
    config.load_dir = None
    config.save_config()
    checkpoints = Path(config.get_checkpoint_dir())
    config.load_dir = checkpoints if newest_first(checkpoints) else None
    trainer: SSATrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()

    def after_step(step: int) -> None:
        on_progress("step", step + 1, config.max_num_iterations)

    after_each_step(trainer, after_step)
    on_start(trainer.pipeline.model.artifacts)
    began = trainer._start_step
    trainer.train()
    return began


def load_trained(config: SSATrainerConfig) -> SSAPipeline:
    """The pipeline of a finished training with its test views, ready to render.

    Raises:
        InputError: its newest checkpoint cannot be read.
    """
    newest = newest_first(Path(config.get_checkpoint_dir()))[0]
    state = load_pipeline_state(newest)
    if state is None:
        raise InputError(f"{newest} cannot be read as a checkpoint", "remove it and repeat the command")
    pipeline = cast(SSAPipeline, config.pipeline.setup(device=config.machine.device_type, test_mode="test"))
    pipeline.load_pipeline(state, step_of(newest))
    pipeline.eval()
    return pipeline
