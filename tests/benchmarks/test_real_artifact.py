"""What an overlay has of a real artifact, and what its training costs beside it."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.real_artifact import MASK, Command, hidden_by, outside
from ssa_nerfstudio.errors import InputError

SHORT = {"steps": 3, "settings": ("num_downscales=0", "overlay=on")}


@pytest.fixture
def dashboard(broken_scene):
    """The tiny scene with a mask of its lower third, where the dashboard is."""
    mask = np.zeros((48, 64), np.uint8)
    mask[32:] = 255
    Image.fromarray(mask).save(broken_scene / MASK)
    return broken_scene


def test_a_training_without_an_overlay_is_compared_outside_the_mask(dashboard, capsys):
    Command(dashboard, beside_off=True, **SHORT).run()
    first, hidden, *table = capsys.readouterr().out.splitlines()
    assert re.match(r"ssa-splatfacto .*; PSNR \d+\.\d\d; IoU 0\.\d+; matte inside 0\.\d+; matte outside 0\.\d+;", first)
    assert re.fullmatch(r"hidden outside the mask \d+\.\d%", hidden)
    assert table[:2] == ["| outside the mask, dB | off | with an overlay |", "|---|---|---|"]
    value = r"\d+\.\d\d \(\d+\.\d, \d+\.\d, \d+\.\d\)"
    for row, where in zip(table[2:], ("everywhere", "where the overlay hides less than half"), strict=True):
        assert re.fullmatch(rf"\| {where} \| {value} \| {value} \|", row)


def test_where_no_overlay_is_trained_there_is_nothing_to_compare(dashboard, capsys, monkeypatch):
    model = SimpleNamespace(artifacts=SimpleNamespace(learned=list))
    trained = SimpleNamespace(metrics={"psnr": 20.0}), SimpleNamespace(model=model)
    monkeypatch.setattr(Command, "_train", lambda self, region, *settings: trained)
    Command(dashboard, beside_off=True).run()
    assert capsys.readouterr().out.splitlines()[1] == "no overlay was trained: there is nothing to compare"


@pytest.mark.parametrize(("value", "where"), [(0, "inside"), (255, "outside")])
def test_a_mask_of_nothing_or_of_all_is_refused(dashboard, value, where):
    Image.fromarray(np.full((48, 64), value, np.uint8)).save(dashboard / MASK)
    with pytest.raises(InputError, match=f"leaves no pixel {where}"):
        Command(dashboard, **SHORT).run()


def test_what_any_matte_hides_more_than_half_is_hidden():
    left, top = torch.zeros(4, 6), torch.zeros(2, 3)
    left[:, :2], top[0] = 0.9, 0.6
    hidden = hidden_by([left, top], (8, 12))
    assert hidden[:, :3].all()
    assert hidden[:2].all()
    assert not hidden[5:, 6:].any()
    assert not hidden_by([], (8, 12)).any()


def test_views_are_listed_after_their_mean():
    views = {"a": {"outside_psnr": 20.0, "psnr": 1.0}, "b": {"outside_psnr": 23.06, "psnr": 2.0}}
    assert outside(views) == "21.53 (20.0, 23.1)"
