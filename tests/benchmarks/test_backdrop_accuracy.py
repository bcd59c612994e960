"""One training rendered with backdrops of several extents."""

from __future__ import annotations

import re

import pytest
import torch

from benchmarks.backdrop_accuracy import Command
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence import gap_points


def test_a_row_for_each_backdrop_the_more_counts_as_hidden_the_larger(tiny_scene, capsys, monkeypatch):
    def nowhere(points, photos, radius):
        return [torch.zeros(*photo.size, 1).bool() for photo in photos]

    # The scene has points everywhere.
    monkeypatch.setattr(gap_points, "near_points", nowhere)
    settings = ("num_downscales=0", "overlay=on")
    Command(tiny_scene, steps=3, settings=settings, hidden=(0.0, 0.1, 1.0)).run()
    head, _, bare, *rows = capsys.readouterr().out.splitlines()
    assert head.startswith("| hidden where T is below | seeds |")
    views = r"\d+\.\d\d \| \d+\.\d, \d+\.\d, \d+\.\d \|"
    assert re.fullmatch(rf"\| no backdrop \| \| {views}", bare)
    found = [re.fullmatch(rf"\| (0|0\.1|1) \| (\d+) \| ({views})", row) for row in rows]
    none, panel, everywhere = [(int(match[2]), match[3]) for match in found if match]
    assert none[0] == 0 < panel[0] < everywhere[0]
    assert bare.endswith(none[1])
    assert len({none[1], panel[1], everywhere[1]}) == 3


def test_a_training_without_an_overlay_has_none(tiny_scene):
    with pytest.raises(InputError, match="no overlay was trained"):
        Command(tiny_scene, steps=1, settings=("num_downscales=0", "overlay=off")).run()
