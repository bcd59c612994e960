"""The measurement scripts: each is listed, and all handle their options as the commands of `ssa` do."""

from __future__ import annotations

import ast
import json
import os
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


@pytest.fixture
def call(monkeypatch, capsys):
    """Call a script as a process would, which has the script's folder on its path: exit code, output and errors."""
    for imported in [each for each in sys.modules if each.partition(".")[0] == "benchmarks"]:
        monkeypatch.delitem(sys.modules, imported)
    monkeypatch.setitem(sys.modules, "benchmarks", None)  # cannot be imported
    monkeypatch.syspath_prepend(FOLDER)

    def called(name: str, *arguments: str) -> tuple[int | str | None, str, str]:
        path = os.path.relpath(FOLDER / name)
        monkeypatch.setattr(sys, "argv", [path, *arguments])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(path, run_name="__main__")
        return end.value.code, *capsys.readouterr()

    return called


@pytest.mark.parametrize("name", sorted(path.name for path in FOLDER.glob("*.py")))
def test_a_script_starts_where_the_repository_is_not_on_the_path(name, call, monkeypatch):
    monkeypatch.chdir(FOLDER.parent)
    code, out, err = call(name, "--help")
    assert code == 0
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
        (["contact_sheet.py", "nowhere/a.png"], 2, "FILE must be a .png file in a folder that exists"),
        (["mutants.py", "--sample", "-3"], 2, "--sample must be at least 0, got -3"),
        (["mutants.py", "--children", "0"], 2, "--children must be at least 1, got 0"),
        (["mutants.py", "--budget", "nan"], 2, "--budget must be at least 1, got nan"),
        (["start_time.py", "--data", "x", "--rounds", "0"], 2, "--rounds must be at least 1, got 0"),
        (["start_time.py", "--data", "x", "--methods"], 2, "--methods has no value; give it at least one"),
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
        (["train.py", "--data", "nowhere", "--output", "nowhere.json"], 2, "nowhere/transforms.json does not exist"),
    ],
)
def test_a_script_ends_as_a_command_does(arguments, code, said):
    command = [sys.executable, f"benchmarks/{arguments[0]}", *arguments[1:]]
    done = subprocess.run(command, cwd=FOLDER.parent, capture_output=True, text=True, timeout=100)
    assert done.returncode == code
    assert said in (done.stderr if code else done.stdout)
    assert len(done.stderr.splitlines()) == (1 if code else 0)
    assert not (FOLDER.parent / "nowhere").exists()


METHODS = "('ssa-splatfacto', 'ssa-splatfacto-fast', 'ssa-splatfacto-mcmc', 'ssa-splatfacto-paper')"
FILE = "file in a folder that exists and can be written, got"
REFUSED = [
    ("guard_cost --data x --method foo", f"invalid choice 'foo' for argument '--method'. Expected one of {METHODS}"),
    ("guard_cost --data x --overlay foo", "invalid choice 'foo' for argument '--overlay'"),
    ("guard_cost --data x --grow -1", "--grow must be at least 0, got -1"),
    ("guard_cost --data x --pairs 3", "--pairs must be at least 4, got 3"),
    ("guard_cost --data x --block 7", "--block must divide 100, got 7"),
    ("guard_cost --data x --scale-factor 0", "--scale-factor must be above 0 and finite, got 0"),
    ("train --data x --output r", "--output must be a .json file that is no folder, got r"),
    ("train --data x --output folder.json", "--output must be a .json file that is no folder, got folder.json"),
    ("train --data x --output r.json --method foo", "invalid choice 'foo' for argument '--method'"),
    ("train --data torn --output r.json", "transforms.json lists 1 photo"),
    ("train --data scene --output r.json --settings x", "--settings x: there is no =; give name=value"),
    ("train --data scene --output r.json --settings sparsity_weight=[1", "--settings sparsity_weight=[1: the value is"),
    ("interval_training --effects foo", "effects has no 'foo'; choose one of dashboard"),
    ("interval_training --effects dashboard finger", "--effects: finger varies from view to view"),
    ("interval_training --views 0", "--views must be at least 2, got 0"),
    ("interval_training --views -1", "--views must be at least 2, got -1"),
    ("interval_training --width 0", "--width must be at least 1, got 0"),
    ("interval_training --height -3", "--height must be at least 1, got -3"),
    ("detection_rates --data x --contiguous --views 8 0", "--views 0 is all views, of which --contiguous"),
    ("detection_rates --data x --views 8 -1", "--views must be at least 0, got -1"),
    ("detection_rates --data x --seeds 0", "--seeds must be at least 1, got 0"),
    ("detection_rates --data", "--data has no value; give it at least one"),
    ("detection_rates --data x --effects none foo", "effects has no 'foo'"),
    ("rig_poses --data x --width 0", "--width must be at least 480, got 0"),
    ("rig_poses --data x --photos 0", "--photos must be at least 6, got 0"),
    ("rig_poses --data x --off-center 100000", "--off-center must be from -120 to 120 at --width 640, got 100000"),
    ("rig_poses --data x --threads 0", "--threads must be at least 1, got 0"),
    ("rig_poses --data wide", "--width 640 makes photos of wide 64 pixels high; choose a larger one"),
    ("rig_poses --data", "--data has no value"),
    ("interval_rates --data", "--data has no value"),
    ("interval_rates --data x --effects recorded foo", "effects has no 'foo'"),
    ("renders_of_methods x --output r.jpg --scene a --effects", "--effects has no value"),
    ("renders_of_methods x --output r.jpg --scene a --effects a --width 0", "--width must be at least 1, got 0"),
    ("renders_of_methods x --output r.foo --scene a --effects a", f"--output must be a .jpg or .png {FILE} r.foo"),
    ("renders_of_methods x --output r.jpg --scene a --effects a --densification b", "invalid choice 'b'"),
    ("lengths_figure x --output n/a.svg", f"--output must be a .png or .svg {FILE} n/a.svg"),
    ("report_screenshot n/a.png", f"OUTPUT must be a .png {FILE} n/a.png"),
    ("sfm_accuracy --data x --output text", "text holds no results of this script"),
    ("sfm_accuracy --data x --output n/a", f"--output must be a {FILE} n/a"),
    ("sfm_accuracy --data x --output a --effects none foo", "effects has no 'foo'"),
    ("sfm_accuracy --data x --output a --max-image-size 0", "--max-image-size must be at least 1, got 0"),
    ("start_accuracy --data x --output n/x.json", f"--output must be a {FILE} n/x.json"),
    ("step_time --data x --enlarge 0", "--enlarge must be above 0 and finite, got 0"),
    ("step_time --data x --enlarge inf", "--enlarge must be above 0 and finite, got inf"),
    ("step_time --data x --gaussians -1", "--gaussians must be at least 0, got -1"),
    ("step_time --data x --profile n/x", f"--profile must be a {FILE} n/x"),
    ("step_time --data x --profile scene", f"--profile must be a {FILE} scene"),
    ("time_to_quality --clean x --data x --output n/x", f"--output must be a {FILE} n/x"),
    ("time_to_quality --clean x --data x --output r --methods splatfacto", "invalid choice 'splatfacto'"),
    ("time_to_quality --clean x --data x --output r --methods", "--methods has no value"),
    ("time_to_quality --clean x --data x --output r --seeds -1", "--seeds must be at least 0, got -1"),
    ("time_to_quality --clean scene --data torn --output r", "transforms.json lists 1 photo"),
    ("time_to_quality --clean scene --data scene --output text", "text holds no results of this script"),
    ("restored_photos --load-config x --photos x --clean x --threshold 3", "--threshold must be in (0, 1), got 3"),
    ("divergence --data x --output n --overlay", "--overlay has no value"),
    ("divergence --data x --output n --steps 0", "--steps must be at least 1, got 0"),
    ("divergence --data x --output n --scale-factor nan", "--scale-factor must be above 0 and finite, got nan"),
    ("divergence --data torn --output n", "transforms.json lists 1 photo"),
    ("start_time --data scene --methods splatfacto foo", "--methods: there is no method 'foo'; choose among"),
    ("acceptance", "no folder of results is named; name the --output folder of ssa bench"),
    ("acceptance nowhere", "nowhere holds no results: it does not exist"),
    ("rows scene nowhere", "scene holds no results; choose the output folder of ssa bench"),
    ("rows nowhere", "nowhere holds no results: it does not exist"),
    ("rasterizers --timed 0", "--timed must be at least 1, got 0"),
    ("rasterizer_revisions --before x --repeats 0", "--repeats must be at least 1, got 0"),
    ("simulator_speed --data x --threads 0", "--threads must be at least 1, got 0"),
    ("simulator_speed --data x --effects mud foo", "effects has no 'foo'"),
    ("viewer_frame_time --data x --height 0", "--height must be at least 1, got 0"),
    ("real_artifact --data x --steps 0", "--steps must be at least 1, got 0"),
    ("real_artifact --data x --beside-off --settings overlay=off", "--settings state overlay=off"),
]


@pytest.mark.parametrize(("line", "said"), REFUSED, ids=[line for line, _ in REFUSED])
def test_what_cannot_be_used_is_named_before_anything_is_measured(line, said, call, tiny_scene, tmp_path, monkeypatch):
    (tmp_path / "scene").symlink_to(tiny_scene)
    meta = {"w": 400, "h": 40, "fl_x": 400, "fl_y": 400, "cx": 200, "cy": 20}
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    for name, count in (("wide", 9), ("torn", 1)):
        (tmp_path / name).mkdir()
        frames = [{"file_path": f"{number}.png", "transform_matrix": pose} for number in range(count)]
        (tmp_path / name / "transforms.json").write_text(json.dumps({**meta, "frames": frames}))
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "text").write_text("text")
    there = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    name, *arguments = line.split(" ")
    code, out, err = call(f"{name}.py", *arguments)
    assert (code, out) == (2, "")
    assert said in err
    assert err.startswith("ssa-nerfstudio: error: ")
    assert err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == there


def test_every_option_is_explained():
    for path in FOLDER.glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for command in [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Command"]:
            for field, text in zip(command.body, [*command.body[1:], None], strict=True):
                if isinstance(field, ast.AnnAssign):
                    assert isinstance(text, ast.Expr), f"{path.name}: {ast.unparse(field)}"


@pytest.mark.slow
def test_an_initialization_is_timed_by_its_parts(tiny_scene, capsys):
    initialization_time.Command(data=tiny_scene, rounds=1).run()
    rows = {row.split("`")[1]: float(row.split("|")[3]) for row in capsys.readouterr().out.splitlines()[2:]}
    parts = ("change_points", "detect", "sample_points", "estimate", "initialize_from")
    assert 0 < sum(rows[part] for part in parts) <= rows["learned_overlays"] + 0.05  # of rounding
    assert rows["estimate_falloff"] + rows["estimate_layers"] <= rows["estimate"] + 0.02
