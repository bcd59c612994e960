"""A prepared trainer: seeded, written down, silent, and without traces in nerfstudio's globals."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils import writer

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.runs.prepared_trainer import begin_run, prepared_trainer
from ssa_nerfstudio.experiments.runs.run_configuration import configure
from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left


def test_a_trainer_is_ready_to_train_and_to_end(tiny_scene, tmp_path):
    config = configure("ssa-splatfacto", tiny_scene, tmp_path, 2, {"num_downscales": 0, "overlay": "off"})
    with no_event_writers_left():
        trainer = prepared_trainer(config)
        assert writer.EVENT_WRITERS == []
        trainer.train()  # a viewer's would wait for ctrl+c at its end
        assert trainer.step == 1
        assert writer.GLOBAL_BUFFER
    assert not writer.GLOBAL_BUFFER
    assert not writer.EVENT_STORAGE
    saved: TrainerConfig = yaml.load((config.get_base_dir() / "config.yml").read_text(), yaml.Loader)
    assert saved.machine.seed == config.machine.seed
    assert not saved.viewer.quit_on_train_completion


def test_a_run_begins_with_the_seed_of_its_configuration(tiny_scene, tmp_path):
    drawn = []
    for seed in (0, 0, 1):
        begin_run(configure("ssa-splatfacto", tiny_scene, tmp_path, 2, seed=seed))
        drawn.append((random.random(), np.random.rand(), float(torch.rand(1))))  # noqa: NPY002
    assert drawn[0] == drawn[1]
    assert all(one != other for one, other in zip(drawn[0], drawn[2], strict=True))


def test_a_setting_that_cannot_be_used_leaves_no_config(tiny_scene, tmp_path):
    with pytest.raises(InputError):
        begin_run(configure("ssa-splatfacto", tiny_scene, tmp_path, 0))
    assert list(tmp_path.iterdir()) == []
