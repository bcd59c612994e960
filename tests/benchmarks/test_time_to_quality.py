"""What `benchmarks/time_to_quality.py` prints of trainings that its file has."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks.time_to_quality import Command
from ssa_nerfstudio.errors import InputError


def _line(method, data, steps, psnr, seconds):
    return {"method": method, "data": data, "steps": steps, "seed": 0, "psnr": psnr, "seconds": seconds}


def test_trainings_of_the_file_are_compared_and_not_repeated(tiny_scene, tmp_path, capsys):
    behind = tmp_path / "behind"
    behind.symlink_to(tiny_scene)
    file = tmp_path / "times.jsonl"
    lines = [
        _line("splatfacto", tiny_scene.name, 30000, 28.0, 300.0),
        _line("ssa-splatfacto-fast", "behind", 4000, 27.95, 15.0),
        _line("ssa-splatfacto", "behind", 15000, 27.5, 60.0),
    ]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    Command(tiny_scene, behind, file, seeds=(0,)).run()
    bar, fast, default = capsys.readouterr().out.splitlines()
    assert bar == f"splatfacto, {tiny_scene.name}, 30000 steps, seed 0: 28.00 dB in 300.0 s"
    assert fast.endswith("27.95 dB in 15.0 s, 0.050 of splatfacto's; +0.05 dB against what is wanted")
    assert default.endswith("0.200 of splatfacto's; -0.40 dB against what is wanted")
    assert len(file.read_text().splitlines()) == 3


def test_a_training_needs_a_gpu(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="there is no CUDA"):
        Command(tiny_scene, tiny_scene, tmp_path / "times.jsonl").run()
    assert not [*tmp_path.iterdir()]
