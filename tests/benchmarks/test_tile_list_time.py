"""Both kinds of lists take turns, in a training that is long enough, where there are both."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch

from benchmarks import tile_list_time
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.runs.prepared_trainer import prepared_trainer
from ssa_nerfstudio.experiments.runs.run_configuration import configure
from ssa_nerfstudio.plugin.training.event_writers import no_event_writers_left
from ssa_nerfstudio.rasterization import cuda, tile_lists


@pytest.mark.parametrize(("has_cuda", "said"), [(False, "there is no CUDA"), (True, "our lists need Triton")])
def test_lists_are_not_compared_where_there_is_one_kind_alone(tiny_scene, monkeypatch, has_cuda, said):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_cuda)
    monkeypatch.setattr(tile_lists, "_TRITON", False)
    with pytest.raises(InputError, match=said):
        tile_list_time.Command(data=tiny_scene).run()


@pytest.mark.skipif(torch.cuda.is_available(), reason="the CPU's rasterizer asks for no lists, so that stand-ins can")
def test_each_kind_has_its_turns_and_entries(tiny_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tile_list_time, "FIRST", 10)
    monkeypatch.setattr(tile_list_time, "TURN", 5)
    monkeypatch.setattr(tile_lists, "_TRITON", True)
    used = []

    def stand_in():
        used.append(tile_lists._TRITON)
        return "offsets", [0] * (1 if tile_lists._TRITON else 2)

    monkeypatch.setattr(cuda, "tile_lists", stand_in)
    config = configure("ssa-splatfacto", tiny_scene, tmp_path, 30, {"num_downscales": 0, "overlay": "off"})
    with no_event_writers_left():
        trainer = prepared_trainer(config)
        rasterizer: Any = cuda
        train_iteration = trainer.train_iteration

        def step(number: int):
            rasterizer.tile_lists()
            return train_iteration(number)

        trainer.train_iteration = step
        tile_list_time.Command(data=tiny_scene)._time(trainer)
    assert used == [True] * 10 + ([False] * 5 + [True] * 5) * 2
    *_, gsplat, theirs, ours, our_own, refinement = capsys.readouterr().out.splitlines()
    for lists, turns in (("gsplat", gsplat), ("our", ours)):
        assert re.fullmatch(rf"{lists} lists, ms a step \(Gaussians\): \d+\.\d\d \(4,000\), \d+\.\d\d \(4,000\)", turns)
    assert (theirs, our_own) == ("  entries in the last view: 2", "  entries in the last view: 1")
    assert re.fullmatch(r"a refinement: \d+\.\d ms", refinement)
