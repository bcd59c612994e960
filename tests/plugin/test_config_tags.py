"""A config.yml that would run a program is refused before nerfstudio reads it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from nerfstudio.configs.method_configs import all_methods

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.config_tags import refuse_calls

COMMAND = "nerfstudio.utils.scripts.run_command"
CALLS = {
    "!!python/object/apply:os.system [touch RAN]": "calls os.system",
    "a: {b: [1, !!python/object/apply:subprocess.check_output [[touch, RAN]]]}": "calls subprocess.check_output",
    "? !!python/object/apply:builtins.eval ['1']\n: 2": "calls builtins.eval",
    "!!python/object/new:os.system [touch RAN]": "calls os.system",
    f"x: !!python/object/apply:{COMMAND} [touch RAN]": f"calls {COMMAND}",
    "_target: !!python/name:os.system ''": "names os.system",
    "!!python/module:subprocess ''": "names subprocess",
    "&a [*a, !!python/object/apply:os.system [touch RAN]]": "calls os.system",
}


@pytest.mark.parametrize("content", CALLS)
def test_a_call_is_refused_and_not_made(content, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("config.yml").write_text(content)
    with pytest.raises(InputError) as refused:
        refuse_calls(Path("config.yml"))
    assert f"it {CALLS[content]}; " in f"{refused.value}; ", refused.value
    assert not Path("RAN").exists()


@pytest.mark.parametrize("method", all_methods)
def test_configurations_of_runs_pass(method, tmp_path):
    """Of nerfstudio's methods and ours."""
    path = tmp_path / "config.yml"
    path.write_text(yaml.dump({"config": all_methods[method], "size": (1, 2)}))
    refuse_calls(path)


def test_values_of_other_packages_pass(tmp_path):
    path = tmp_path / "config.yml"
    path.write_text("a: !!python/object/apply:other_method.cameras.Kind [1]\nb: !!python/name:other_method.Model ''\n")
    refuse_calls(path)


@pytest.mark.parametrize("content", [b"", b"x: [", b"\xff\xfe", b"[" * 5000])
def test_what_cannot_be_parsed_is_left_to_the_reader(content, tmp_path):
    path = tmp_path / "config.yml"
    path.write_bytes(content)
    refuse_calls(path)
    refuse_calls(tmp_path / "none.yml")


def test_nerfstudios_commands_refuse_it_before_they_read_it(tmp_path):
    config = tmp_path / "config.yml"
    config.write_text("!!python/object/apply:os.system [touch RAN]")
    process = subprocess.run(
        [Path(sys.executable).with_name("ns-eval"), "--load-config", config.name],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 2
    (line,) = [line for line in process.stderr.splitlines() if "error" in line]
    assert "config.yml is no run's configuration: it calls os.system" in line
    assert not (tmp_path / "RAN").exists()
