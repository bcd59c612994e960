"""`benchmarks/time_to_quality.py`: what it prints of trainings that its file has."""

import json

import torch


def _line(method, data, steps, psnr, seconds):
    return {"method": method, "data": data, "steps": steps, "seed": 0, "psnr": psnr, "seconds": seconds}


def test_trainings_of_the_file_are_compared_and_not_repeated(call, tiny_scene, tmp_path):
    behind = tmp_path / "behind"
    behind.symlink_to(tiny_scene)
    file = tmp_path / "times.jsonl"
    lines = [
        _line("splatfacto", tiny_scene.name, 30000, 28.0, 300.0),
        _line("ssa-splatfacto-fast", "behind", 4000, 27.95, 15.0),
        _line("ssa-splatfacto", "behind", 15000, 27.5, 60.0),
    ]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    code, out, _ = call(
        "time_to_quality.py", "--clean", str(tiny_scene), "--data", str(behind), "--output", str(file), "--seeds", "0"
    )
    assert code == 0
    bar, fast, default = out.splitlines()
    assert bar == f"splatfacto, {tiny_scene.name}, 30000 steps, seed 0: 28.00 dB in 300.0 s"
    assert fast.endswith("27.95 dB in 15.0 s, 0.050 of splatfacto's; +0.05 dB against what is wanted")
    assert default.endswith("0.200 of splatfacto's; -0.40 dB against what is wanted")
    assert len(file.read_text().splitlines()) == 3


def test_a_training_needs_a_gpu(call, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    scene = str(tiny_scene)
    code, out, err = call(
        "time_to_quality.py", "--clean", scene, "--data", scene, "--output", str(tmp_path / "times.jsonl")
    )
    assert (code, out, list(tmp_path.iterdir())) == (2, "", [])
    assert "there is no CUDA" in err
