"""Schedules of a shorter or longer run: all of them, and none beyond what makes sense."""

from __future__ import annotations

import copy

import pytest
import torch

from ssa_nerfstudio.plugin.methods import METHODS
from ssa_nerfstudio.plugin.training.schedules import MODEL_STEPS, densification, scaled

every_method = pytest.mark.parametrize("method", METHODS)


def of_length(method: str, steps: int, **model):
    config = copy.deepcopy(METHODS[method])
    config.max_num_iterations = steps
    for name, value in model.items():
        setattr(config.pipeline.model, name, value)
    return config


@every_method
def test_a_full_run_is_as_configured(method):
    config = of_length(method, 30_000)
    full = scaled(config)
    assert full is not config
    assert vars(full.pipeline.model) == vars(config.pipeline.model)
    assert full.optimizers == config.optimizers
    assert full.steps_per_eval_image == config.steps_per_eval_image


@every_method
@pytest.mark.parametrize("factor", [0.5, 2])
def test_every_setting_that_counts_steps_follows_the_length(method, factor):
    config = of_length(method, int(30_000 * factor))
    found = scaled(config)
    before, after = config.pipeline.model, found.pipeline.model
    for name in (*MODEL_STEPS, "refine_every"):
        assert getattr(after, name) == pytest.approx(factor * getattr(before, name), abs=0.5), name
    for name, entry in config.optimizers.items():
        if entry["scheduler"] is not None:
            made = found.optimizers[name]["scheduler"]
            assert made.max_steps == factor * entry["scheduler"].max_steps
            assert made.warmup_steps == factor * entry["scheduler"].warmup_steps
    assert vars(config.pipeline.model) == vars(METHODS[method].pipeline.model), "the configuration itself was changed"


def test_what_is_off_stays_off_and_what_is_on_stays_on():
    found = scaled(of_length("ssa-splatfacto", 1, warmup_length=0, stop_split_at=0, mcmc_stop_at=3))
    model = found.pipeline.model
    assert (model.warmup_length, model.stop_split_at, model.mcmc_stop_at) == (0, 0, 1)
    assert model.refine_every == 10, "statistics need a few views"
    assert all(entry["scheduler"].max_steps == 1 for entry in found.optimizers.values() if entry["scheduler"])


def test_refinements_of_a_run_of_a_few_steps_are_ten_steps_apart():
    assert scaled(of_length("ssa-splatfacto", 3_300)).pipeline.model.refine_every == 11
    assert scaled(of_length("ssa-splatfacto", 1_500)).pipeline.model.refine_every == 10


def test_a_run_of_no_steps_is_scaled_too():
    assert scaled(of_length("ssa-splatfacto", 0)).optimizers["overlay"]["optimizer"].lr == pytest.approx(0.02)


@pytest.mark.parametrize(("steps", "expected"), [(1, "adc"), (6_999, "adc"), (7_000, "mcmc"), (30_000, "mcmc")])
def test_a_training_long_enough_for_mcmc_has_it_unless_another_is_stated(steps, expected):
    assert densification("auto", steps) == expected
    assert densification("adc", steps) == "adc"
    assert densification("mcmc", steps) == "mcmc"


def test_a_resumed_training_keeps_its_densification_unless_another_is_stated():
    for steps in (10, 30_000):
        assert densification("auto", steps, {"_model.by_mcmc": torch.tensor(True)}) == "mcmc"
        assert densification("auto", steps, {"_model.by_mcmc": torch.tensor(False)}) == "adc"
        assert densification("auto", steps, {}) == "adc", "a checkpoint of before"
        assert densification("mcmc", steps, {"_model.by_mcmc": torch.tensor(False)}) == "mcmc"


@pytest.mark.parametrize(("method", "expected"), zip(METHODS, ("mcmc", "adc", "mcmc", "adc"), strict=True))
def test_the_densification_of_the_methods_as_they_ship(method, expected):
    config = METHODS[method]
    assert densification(config.pipeline.model.strategy, config.max_num_iterations) == expected


def test_settings_of_a_subclass_that_count_steps_follow_as_well():
    config = of_length("ssa-splatfacto", 3_000)

    class Model(type(config.pipeline.model)):
        own_steps = ("head_start",)

    config.pipeline.model = Model(**vars(config.pipeline.model))
    config.pipeline.model.head_start = 700  # pyright: ignore[reportAttributeAccessIssue]
    assert scaled(config).pipeline.model.head_start == 70  # pyright: ignore[reportAttributeAccessIssue]
