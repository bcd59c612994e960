"""The measurement scripts: each is listed, and all handle their options as the commands of `ssa` do."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import initialization_time

FOLDER = Path(__file__).parents[2] / "benchmarks"


def test_the_readme_lists_every_script():
    rows = re.findall(r"^\| `(\w+\.py)` \|.*`python benchmarks/(\w+\.py)", (FOLDER / "README.md").read_text(), re.M)
    assert [listed for listed, _ in rows] == [called for _, called in rows]
    assert sorted(listed for listed, _ in rows) == sorted(path.name for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize("name", sorted(path.name for path in FOLDER.glob("*.py")))
def test_a_script_starts_where_the_repository_is_not_on_the_path(name, monkeypatch, capsys):
    """As a process would, which has the script's folder on its path, and imports all libraries anew."""
    for imported in [each for each in sys.modules if each.partition(".")[0] == "benchmarks"]:
        monkeypatch.delitem(sys.modules, imported)
    monkeypatch.setitem(sys.modules, "benchmarks", None)  # cannot be imported
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.chdir(FOLDER.parent)
    monkeypatch.setattr(sys, "argv", [f"benchmarks/{name}", "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(f"benchmarks/{name}", run_name="__main__")
    assert end.value.code == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"usage: python benchmarks/{name}")
    assert err == ""


def test_no_script_imports_nerfstudio_before_it_runs():
    """Its imports take seconds, and warn until `run_script` has begun: before all that --help and errors say."""
    names = sorted(path.stem for path in FOLDER.glob("*.py"))
    code = f"import {', '.join(names)}, sys; print('nerfstudio' in sys.modules)"
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, cwd=FOLDER, capture_output=True, text=True, timeout=100, check=True)
    assert (done.stdout, done.stderr) == ("False\n", "")


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["contact_sheet.py", "--help"], 0, "usage: python benchmarks/contact_sheet.py"),
        (["contact_sheet.py", "a.png", "--fiel"], 2, "--fiel"),
        (["contact_sheet.py", "nowhere/a.png"], 2, "nowhere/a.png cannot be written; name a .png file in a folder"),
        (["mutants.py", "--sample", "-3"], 2, "--sample must be at least 0, got -3"),
        (["mutants.py", "--children", "0"], 2, "--children must be at least 1, got 0"),
        (["mutants.py", "--budget", "nan"], 2, "--budget must be at least 1, got nan"),
        (["start_time.py", "--data", "x", "--rounds", "0"], 2, "--rounds must be at least 1, got 0"),
        (["start_time.py", "--data", "x", "--methods"], 2, "no method is given"),
        (["initialization_time.py", "--data", "nowhere"], 2, "nowhere"),
        (["divergence.py", "--data", "nowhere", "--output", "nowhere"], 2, "nowhere/transforms.json does not exist"),
        (["divergence.py", "--data", "x", "--output", "nowhere", "--every", "0"], 2, "--every must be at least 1"),
        (["guard_cost.py", "--data", "nowhere"], 2, "nowhere/transforms.json does not exist"),
        (["guard_cost.py", "--data", "x", "--block", "0"], 2, "--block must divide 100"),
        (["step_time.py", "--data", "nowhere"], 2, "nowhere/transforms.json does not exist"),
        (
            ["step_time.py", "--data", "x", "--method", "ssa-splatfacto-mcmc", "--gaussians", "9"],
            2,
            "MCMC splits no Gaussians",
        ),
        (["tile_list_time.py", "--help"], 0, "usage: python benchmarks/tile_list_time.py"),
        (["tile_list_time.py", "--data", "nowhere"], 2, "nowhere/transforms.json does not exist"),
        (["tile_list_time.py", "--data", "x", "--steps", "1799"], 2, "--steps must be at least 1800"),
        (
            ["restored_photos.py", "--load-config", "nowhere", "--photos", "x", "--clean", "x"],
            2,
            "nowhere does not exist",
        ),
        (["start_accuracy.py", "--data", "nowhere"], 2, "nowhere/transforms.json does not exist"),
        (["export_speed.py", "--output", "nowhere", "--gaussians", "0"], 2, "--gaussians must be at least 1, got 0"),
        (["train.py", "--data", "nowhere", "--output", "nowhere"], 2, "nowhere/transforms.json does not exist"),
    ],
)
def test_a_script_ends_as_a_command_does(arguments, code, said):
    command = [sys.executable, f"benchmarks/{arguments[0]}", *arguments[1:]]
    done = subprocess.run(command, cwd=FOLDER.parent, capture_output=True, text=True, timeout=100)
    assert done.returncode == code
    assert said in (done.stderr if code else done.stdout)
    assert len(done.stderr.splitlines()) == (1 if code else 0)
    assert not (FOLDER.parent / "nowhere").exists()


@pytest.mark.slow
def test_an_initialization_is_timed_by_its_parts(tiny_scene, capsys):
    initialization_time.Command(data=tiny_scene, rounds=1).run()
    rows = {row.split("`")[1]: float(row.split("|")[3]) for row in capsys.readouterr().out.splitlines()[2:]}
    parts = ("change_points", "detect", "sample_points", "estimate", "initialize_from")
    assert 0 < sum(rows[part] for part in parts) <= rows["learned_overlays"] + 0.05  # of rounding
    assert rows["estimate_falloff"] + rows["estimate_layers"] <= rows["estimate"] + 0.02
