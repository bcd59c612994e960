"""Schedules of 30000 steps made to fit a run of another length."""

from __future__ import annotations

import copy
from typing import Any, TypeVar

from nerfstudio.engine.trainer import TrainerConfig

Config = TypeVar("Config", bound=TrainerConfig)

FULL_LENGTH = 30_000
"""Steps that every schedule of splatfacto and 3DGS assumes."""
SHORTEST_REFINEMENT = 10
"""Refinement is never more frequent than this many steps: its statistics need a few views to mean something."""
SHORTEST_BETWEEN_PICTURES = 100
"""Pictures in the log of a shorter run are never nearer to each other than this many steps: each is an evaluation."""
STEPS_OF_AN_OVERLAY = 7_000
"""An overlay needs this many steps at its learning rate. Adam moves a logit by no more than that rate a step, so in a
shorter run it is raised in proportion ..."""
FASTEST_OVERLAY = 4.0
"""... up to this factor."""

_MODEL_STEPS = (
    "warmup_length",
    "resolution_schedule",
    "sh_degree_interval",
    "stop_screen_size_at",
    "stop_split_at",
    "mcmc_stop_at",
    "scene_head_start",
)


def scaled(config: Config) -> Config:
    """A copy of a run's configuration with every schedule scaled by its number of steps / 30000.

    Scaled are: learning-rate decay and warm-up, the resolution schedule, spherical harmonics, the refinement's start,
    stop and interval, and with the interval the opacity resets, which are counted in refinements; so that a short run
    is seen too, the steps between two pictures in the log; and, below 7000 steps, the overlay's learning rate.
    """
    config = copy.deepcopy(config)
    factor = config.max_num_iterations / FULL_LENGTH
    model: Any = config.pipeline.model
    for name in _MODEL_STEPS:
        steps = getattr(model, name)
        setattr(model, name, max(1, round(steps * factor)) if steps else 0)  # 0 switches a schedule off
    model.refine_every = max(SHORTEST_REFINEMENT, round(model.refine_every * factor))
    pictures = max(SHORTEST_BETWEEN_PICTURES, round(config.steps_per_eval_image * factor))
    config.steps_per_eval_image = min(config.steps_per_eval_image, pictures)  # 0 stays 0: none
    shortened = STEPS_OF_AN_OVERLAY / max(1, config.max_num_iterations)
    config.optimizers["overlay"]["optimizer"].lr *= min(FASTEST_OVERLAY, max(1.0, shortened))
    for entry in config.optimizers.values():
        scheduler = entry["scheduler"]
        if scheduler is not None:
            scheduler.max_steps = max(1, round(scheduler.max_steps * factor))
            scheduler.warmup_steps = round(scheduler.warmup_steps * factor)
    return config
