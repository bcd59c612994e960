"""Fits settings to the length of a run: schedules, which all assume 30,000 steps, and the densification."""

from __future__ import annotations

import copy
from typing import Any, Literal, TypeVar

from nerfstudio.engine.trainer import TrainerConfig

Config = TypeVar("Config", bound=TrainerConfig)

FULL_LENGTH = 30_000
"""Steps that every schedule of splatfacto and 3DGS assumes."""
DEFAULT_LENGTH = 15_000
"""Steps of a training with a GPU: 7000 lose 0.4 dB on the mean of four captures (docs/cost.md)."""
FAST_LENGTH = 4_000
"""The shortest length of ADC that was within half a decibel of its 7000 steps on every capture (docs/cost.md)."""
MCMC_LENGTH = 7_000
"""With 7000 steps MCMC is as good as ADC on the mean of two captures, and better on two; with 4000 it is behind on most
(docs/cost.md)."""
MIN_REFINE_EVERY = 10
"""Lower bound of the steps between two refinements, whose statistics need a few views."""
MIN_STEPS_PER_IMAGE = 100
"""Lower bound of the steps between two logged images, each of which is an evaluation."""
OVERLAY_STEPS = 7_000
"""Steps that an overlay needs at its learning rate. Adam moves a logit by at most that rate per step, so shorter runs
raise it in proportion, up to `MAX_OVERLAY_FACTOR`."""
MAX_OVERLAY_FACTOR = 4.0
"""Upper bound of that factor."""

MODEL_STEPS = (
    "warmup_length",
    "resolution_schedule",
    "sh_degree_interval",
    "stop_screen_size_at",
    "stop_split_at",
    "mcmc_stop_at",
)
"""Settings of the model that count steps and are scaled; 0 switches one off."""


def densification(
    strategy: Literal["auto", "adc", "mcmc"], steps: int, resumed: dict[str, Any] | None = None
) -> Literal["adc", "mcmc"]:
    """The densification of a training.

    Args:
        strategy: the model's setting.
        steps: of the training.
        resumed: state of the pipeline to go on from, whose densification "auto" keeps, however long the rest is. Before
            "auto" there was, checkpoints did not state it: theirs was ADC unless the setting says otherwise.
    """
    if strategy != "auto":
        return strategy
    mcmc = steps >= MCMC_LENGTH if resumed is None else bool(resumed.get("_model.by_mcmc", False))
    return "mcmc" if mcmc else "adc"


def scaled(config: Config) -> Config:
    """Copy a run's configuration with every schedule scaled by its number of steps / 30000.

    Scaled are learning-rate decay and warm-up, the resolution schedule, spherical harmonics, start, stop and interval
    of the refinement (and with it the opacity resets, which count refinements), the steps between two logged images,
    and below 7,000 steps the overlay's learning rate.
    """
    config = copy.deepcopy(config)
    factor = config.max_num_iterations / FULL_LENGTH
    model: Any = config.pipeline.model
    for name in (*MODEL_STEPS, *model.own_steps):
        steps = getattr(model, name)
        setattr(model, name, max(1, round(steps * factor)) if steps else 0)  # 0 switches a schedule off
    model.refine_every = max(MIN_REFINE_EVERY, round(model.refine_every * factor))
    pictures = max(MIN_STEPS_PER_IMAGE, round(config.steps_per_eval_image * factor))
    config.steps_per_eval_image = min(config.steps_per_eval_image, pictures)  # 0 stays 0: none
    shortened = OVERLAY_STEPS / max(1, config.max_num_iterations)
    config.optimizers["overlay"]["optimizer"].lr *= min(MAX_OVERLAY_FACTOR, max(1.0, shortened))
    for entry in config.optimizers.values():
        scheduler = entry["scheduler"]
        if scheduler is not None:
            scheduler.max_steps = max(1, round(scheduler.max_steps * factor))
            scheduler.warmup_steps = round(scheduler.warmup_steps * factor)
    return config
