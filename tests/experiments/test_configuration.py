"""YAML in, dataclass out; shipped configurations; every message names the file and the key."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.configuration import build, locate, read, shipped
from ssa_nerfstudio.experiments.effects.catalogue import EFFECTS, effect_class
from ssa_nerfstudio.experiments.simulation.scene import read_effects, read_scene

REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True)
class Inner:
    depth: int = 1


@dataclass(frozen=True)
class Outer:
    rate: float
    name: str = "x"
    on: bool = False
    kind: Literal["a", "b"] = "a"
    pair: tuple[int, int] = (0, 0)
    many: list[float] = field(default_factory=list)
    maybe: int | None = None
    folder: Path = Path()
    inner: Inner = field(default_factory=Inner)
    others: tuple[Inner, ...] = ()
    free: Any = None

    def __post_init__(self) -> None:
        if self.rate < 0:
            raise ValueError(f"Outer.rate must not be negative, got {self.rate}")


def test_values_become_what_the_fields_say():
    stated = {"rate": 2, "pair": [1, 2], "many": [1, 2.5], "folder": "a/b", "inner": {"depth": 3}, "free": {"k": []}}
    built = build(Outer, stated, "here")
    assert built == Outer(2.0, pair=(1, 2), many=[1.0, 2.5], folder=Path("a/b"), inner=Inner(3), free={"k": []})
    assert isinstance(built.rate, float)
    assert build(Outer, {"rate": 0, "maybe": 4}, "here").maybe == 4
    assert build(Outer, {"rate": 0, "maybe": None}, "here").maybe is None


@pytest.mark.parametrize(
    ("text", "number"), [("1e-3", 0.001), ("2E+1", 20.0), (".5e1", 5.0), ("1.5", 1.5), ("7", 7.0), (".inf", math.inf)]
)
def test_numbers_are_read_as_in_yaml_1_2(text, number, tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text(f"rate: {text}\nfree: [{text}, '{text}', e{text}]")
    built = build(Outer, read(path), str(path))
    assert (built.rate, built.free) == (number, [number, text, f"e{text}"])


def test_values_that_refer_to_themselves_are_refused(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("rate: 1\nfree: &a [*a]")
    with pytest.raises(InputError, match=r"x\.yaml is no valid YAML \(with its aliases it holds more than 100000"):
        read(path)
    values: dict = {"rate": 1}
    values["free"] = values
    with pytest.raises(InputError, match=r"x\.yaml: the values cannot be represented"):
        build(Outer, values, "x.yaml")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "Input should be an object, got []"),
        ({}, "rate is missing"),
        ({"rate": 1, "nme": "y"}, "unknown key 'nme' (did you mean 'name'?); known are rate, name, on"),
        ({"rate": -1}, "Outer.rate must not be negative, got -1.0"),
        ({"rate": "fast"}, "rate: Input should be a valid number, got 'fast'"),
        ({"rate": True}, "rate: Input should be a valid number, got True"),
        ({"rate": "3"}, "rate: Input should be a valid number, got '3'"),
        ({"rate": None}, "rate: Input should be a valid number, got None"),
        ({"rate": 1, "name": 3}, "name: Input should be a valid string, got 3"),
        ({"rate": 1, "on": 1}, "on: Input should be a valid boolean, got 1"),
        ({"rate": 1, "kind": "c"}, "kind: Input should be 'a' or 'b', got 'c'"),
        ({"rate": 1, "pair": [1]}, "pair[1] is missing"),
        ({"rate": 1, "pair": [1, 2.5]}, "pair[1]: Input should be a valid integer, got 2.5"),
        ({"rate": 1, "many": 3}, "many: Input should be a valid array, got 3"),
        ({"rate": 1, "maybe": "no"}, "maybe: Input should be a valid integer, got 'no'"),
        ({"rate": 1, "maybe": "3"}, "maybe: Input should be a valid integer, got '3'"),
        ({"rate": 1, "maybe": True}, "maybe: Input should be a valid integer, got True"),
        ({"rate": 1, "folder": 3}, "folder: Input should be a valid string, got 3"),
        ({"rate": 1, "inner": {"dept": 3}}, "unknown key 'dept' in inner (did you mean 'depth'?)"),
        ({"rate": 1, "inner": 3}, "inner: Input should be an object, got 3"),
        ({"rte": 1}, "unknown key 'rte' (did you mean 'rate'?)"),
        ({"rate": 1, "others": [{"depth": 1}, {"dept": 3}]}, "unknown key 'dept' in others[1] (did you mean 'depth'?)"),
    ],
)
def test_wrong_values_are_named_in_one_line(values, message):
    with pytest.raises(InputError) as caught:
        build(Outer, values, "file.yaml")
    assert f"file.yaml: {message}" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1", "holds no keys and values"),
        ("", "holds no keys and values"),
        ("a: [", "is no valid YAML"),
        ("a: 1\nb: 2\na: 3", "key 'a' twice"),
        ("a: {1: b}", "key 1 must be text"),
        ("on: 1", "key True must be text"),
        ("a: !!python/object:os.system x", "is no valid YAML"),
        (b"a: \xff", "cannot be read"),
    ],
)
def test_files_that_are_no_configuration_are_refused(text, message, tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as caught:
        read(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_every_effect_is_shipped_with_its_defaults():
    for name in EFFECTS:
        assert read_effects((name,)) == ((name, effect_class(name)()),)


@pytest.mark.parametrize("name", shipped("effects"))
def test_shipped_effects_can_be_read(name):
    ((effect, _),) = read_effects((name,))
    assert name.startswith(effect)


@pytest.mark.parametrize("name", shipped("scenes"))
def test_shipped_scenes_can_be_read(name):
    assert read_scene(name).effects


def test_names_and_files_are_found(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("effect: dust")
    assert locate("effects", str(own)) == own
    assert locate("effects", "mud-thick").name == "mud-thick.yaml"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed: 1", "effects is missing"),
        ("effects: rain", "effects: Input should be a valid array, got 'rain'"),
        ("effects: []\nseed: -1", "SceneFile.seed must not be negative, got -1"),
        ("effects: []\nseed: a", "seed: Input should be a valid integer, got 'a'"),
        ("effects: []\nsed: 1", "unknown key 'sed' (did you mean 'seed'?)"),
        ("effects: [rian]", "effects has no 'rian' (did you mean 'rain'?)"),
        ("effects: [3]", "effects[0]: key 'effect' is missing"),
        ("effects: [{alpha: 1}]", "effects[0]: key 'effect' is missing"),
        ("effects: [dust, {effect: fog}]", "effects[1]: effect 'fog' is unknown; choose one of watermark"),
        ("effects: [{effect: [dust]}]", "effects[0]: effect ['dust'] is unknown"),
        ("effects: [{effect: rain, intensty: 1}]", "effects[0]: unknown key 'intensty' (did you mean 'intensity'?)"),
        (
            "effects: [{effect: rain, intensity: 2}]",
            "effects[0]: intensity: Input should be less than or equal to 1, got 2",
        ),
        (
            "effects: [{effect: rain, intensity: .nan}]",
            "effects[0]: intensity: Input should be less than or equal to 1, got nan",
        ),
        (
            "effects: [{effect: rain, intensity: lots}]",
            "effects[0]: intensity: Input should be a valid number, got 'lots'",
        ),
        ("effects: [{effect: mud, color: [1, 2]}]", "effects[0]: color[2] is missing"),
        (
            "effects: [{effect: mud, color: [1, 2, 256]}]",
            "effects[0]: color[2]: Input should be less than or equal to 255, got 256",
        ),
        (
            "effects: [{effect: finger, side: middle}]",
            "effects[0]: side: Input should be 'left', 'right', 'top' or 'bottom', got 'middle'",
        ),
    ],
)
def test_bad_scenes_are_named_in_one_line(text, message, tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_scene(str(path))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    if "has no" not in message:
        assert str(path) in str(caught.value)


def test_a_bad_effect_file_is_named(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("effect: vignette\nstrength: 2")
    with pytest.raises(InputError, match=r"mine\.yaml: strength: Input should be less than or equal to 1, got 2"):
        read_effects((str(path),))


def test_configurations_and_templates_are_installed_with_the_package(tmp_path):
    built = tmp_path / "built"
    command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(tmp_path), "build_py"]
    subprocess.run([*command, "--build-lib", str(built)], cwd=REPOSITORY, check=True, capture_output=True)
    code = "from ssa_nerfstudio.experiments.configuration import shipped as s; "
    code += "print(*s('effects').values(), *s('scenes').values())"
    environment = {**os.environ, "PYTHONPATH": str(built)}
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    ).stdout.split()
    templates = Path("ssa_nerfstudio/experiments/templates")
    assert {path.name for path in (built / templates).iterdir()} == {p.name for p in (REPOSITORY / templates).iterdir()}
    folder = built / "ssa_nerfstudio/configs"
    expected = sorted(path.relative_to(REPOSITORY / "configs") for path in (REPOSITORY / "configs").glob("*/*.yaml"))
    assert sorted(Path(path).relative_to(folder) for path in found) == [
        path for path in expected if path.parent.name in ("effects", "scenes")
    ]
