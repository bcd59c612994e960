"""Files that people write, with something wrong in them at random: they are read, or refused in one line."""

from __future__ import annotations

import copy
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.data.transforms import Dataset
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import read_benchmark
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan, plan_tradeoff
from ssa_nerfstudio.experiments.configuration import shipped
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene
from ssa_nerfstudio.experiments.simulation.scene import read_effects, read_scene
from ssa_nerfstudio.plugin.validation import check_transforms

ODD = [
    None,
    True,
    False,
    -1,
    0,
    1,
    7,
    1e308,
    -1e-308,
    math.nan,
    math.inf,
    "",
    "x",
    "../..",
    "é" * 300,
    [],
    {},
    [1, 2],
    [[]],
]
"""What is put in the place of a value."""
OFTEN = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def places(content: Any, path: tuple = ()) -> list[tuple]:
    """The path to every value of nested dictionaries and lists."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [path] * bool(path) + [place for key, value in inner for place in places(value, (*path, key))]


def mutated(content: Any, draw: Callable) -> Any:
    """A copy with one to three values replaced, removed or renamed."""
    content = copy.deepcopy(content)
    for _ in range(draw(st.integers(1, 3))):
        where = draw(st.sampled_from(places(content) or [()]))
        if not where:
            break
        holder = content
        for key in where[:-1]:
            holder = holder[key]
        how = draw(st.sampled_from(["replace", "remove", "rename"]))
        if how == "replace":
            holder[where[-1]] = copy.deepcopy(draw(st.sampled_from(ODD)))
        elif how == "remove" or isinstance(holder, list):
            del holder[where[-1]]
        else:
            holder[draw(st.sampled_from(["", "effect", "frames", "steps", 3]))] = holder.pop(where[-1])
    return content


def one_line(refused: InputError, culprit: str = "") -> None:
    assert str(refused)
    assert culprit in str(refused)
    assert "\n" not in str(refused)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("mutated") / "dataset"
    DemoScene(views=6, test_views=2, width=16, height=12).write(folder, None)
    return folder


@OFTEN
@given(data=st.data())
def test_transforms_are_read_or_refused(data, dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("t") / "d"
    shutil.copytree(dataset, folder)
    original = json.loads((dataset / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps(mutated(original, data.draw)))
    for check in (lambda: check_transforms(folder), lambda: Dataset.read(folder, 8)):
        try:
            check()
        except InputError as refused:
            one_line(refused)
    shutil.rmtree(folder)


@OFTEN
@given(data=st.data())
def test_scenes_and_effects_are_read_or_refused(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("s")
    readers = ((shipped("scenes"), read_scene), (shipped("effects"), lambda path: read_effects((path,))))
    for files, read in readers:
        path = data.draw(st.sampled_from(sorted(files.values())))
        (folder / path.name).write_text(yaml.safe_dump(mutated(yaml.safe_load(path.read_text()), data.draw)))
        try:
            read(str(folder / path.name))
        except InputError as refused:
            one_line(refused, path.name)


@OFTEN
@given(data=st.data())
def test_benchmarks_are_planned_or_refused(data, tmp_path_factory):
    path = data.draw(st.sampled_from(sorted(shipped("benchmarks").values())))
    file = tmp_path_factory.mktemp("b") / path.name
    file.write_text(yaml.safe_dump(mutated(yaml.safe_load(path.read_text()), data.draw)))
    try:
        benchmark = read_benchmark(str(file))
        plan(benchmark)
        if benchmark.tradeoff is not None:
            plan_tradeoff(benchmark)
    except InputError as refused:
        one_line(refused)


@settings(max_examples=100, deadline=None)
@given(content=st.binary(max_size=80), name=st.sampled_from(["scene.yaml", "transforms.json"]))
@example(content=b"\xff\xfe\x00", name="scene.yaml")
@example(content=b"a: &a [*a]", name="scene.yaml")
@example(content=b"[" * 80, name="transforms.json")
def test_anything_at_all_is_refused(content, name, tmp_path_factory):
    path = tmp_path_factory.mktemp("x") / name
    path.write_bytes(content)
    readers = {
        "scene.yaml": [lambda: read_scene(str(path)), lambda: read_benchmark(str(path))],
        "transforms.json": [lambda: check_transforms(path.parent), lambda: Dataset.read(path.parent, 8)],
    }
    for read in readers[name]:
        with pytest.raises(InputError) as caught:
            read()
        one_line(caught.value)
