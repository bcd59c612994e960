"""nerfstudio's trainers, ready to train: seeded, written down and set up."""

from __future__ import annotations

from typing import Any

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils import writer

from ssa_nerfstudio.plugin.training.random_numbers import seed_all


def prepared_trainer(config: TrainerConfig) -> Any:
    """Begin a run and set its trainer up: photos and model are loaded, and `train` needs no one to end it.

    Args:
        config: of one of this plugin's methods, or of nerfstudio's own.

    Returns:
        The configuration's trainer, `SSATrainer` for this plugin's methods. Its own `config` may be a copy.

    Raises:
        InputError: a setting of this plugin's methods or the dataset cannot be used.
    """
    begin_run(config)
    return set_up_trainer(config)


def begin_run(config: TrainerConfig) -> None:
    """Seed all random numbers by `machine.seed`, check the settings, and write the run's config.yml.

    Raises:
        InputError: a setting cannot be used.
    """
    seed_all(config.machine.seed)
    config.set_timestamp()
    config.save_config()


def set_up_trainer(config: TrainerConfig) -> Any:
    """Set up the trainer of a run that has begun; what is changed in between is not in config.yml.

    Returns:
        As `prepared_trainer`.

    Raises:
        InputError: the dataset cannot be used.
    """
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    writer.EVENT_WRITERS.clear()  # not read by anything here
    trainer.config.viewer.quit_on_train_completion = True
    return trainer
