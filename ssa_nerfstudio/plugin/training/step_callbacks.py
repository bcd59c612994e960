"""Calls of one's own between the steps of nerfstudio's loop."""

from __future__ import annotations

from collections.abc import Callable

from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer


def after_each_step(trainer: Trainer, call: Callable[[int], None]) -> None:
    """Let a trainer that is set up call this after every step, after all that it calls already.

    Args:
        trainer: nerfstudio's or this plugin's.
        call: takes the step's number, from 0.
    """
    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], call))
