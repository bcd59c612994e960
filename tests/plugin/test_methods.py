"""Settings of the methods: what is splatfacto's stays splatfacto's."""

from __future__ import annotations

import pytest
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.engine.trainer import TrainerConfig

from ssa_nerfstudio.plugin.methods import METHODS

SPLATFACTO = method_configs["splatfacto"]
assert isinstance(SPLATFACTO, TrainerConfig)
RATES = SPLATFACTO.optimizers
VIEWER = SPLATFACTO.viewer
SCHEDULE = ("lr_final", "max_steps", "warmup_steps", "lr_pre_warmup", "ramp")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("group", sorted(RATES))
def test_learning_rates_and_their_schedules_are_those_of_splatfacto(method, group):
    ours, upstream = METHODS[method].optimizers[group], RATES[group]
    assert ours["optimizer"].lr == upstream["optimizer"].lr
    assert (ours["scheduler"] is None) == (upstream["scheduler"] is None)
    if ours["scheduler"] is not None:
        assert [getattr(ours["scheduler"], name) for name in SCHEDULE] == [
            getattr(upstream["scheduler"], name) for name in SCHEDULE
        ]


@pytest.mark.parametrize("method", METHODS)
def test_a_training_opens_the_viewer_and_ends_without_a_profile(method):
    config = METHODS[method]
    assert config.vis == "viewer"
    assert config.viewer.num_rays_per_chunk == VIEWER.num_rays_per_chunk
    assert config.logging.profiler == "none"
