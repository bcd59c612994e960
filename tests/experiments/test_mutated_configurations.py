"""Configuration files with something wrong in them at random: they are read, or refused in one line."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mutations import OFTEN, mutated, one_line

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import read_benchmark
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan, plan_tradeoff
from ssa_nerfstudio.experiments.configuration import shipped
from ssa_nerfstudio.experiments.simulation.scene import read_effects, read_scene


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


@settings(max_examples=50, deadline=None)
@given(content=st.binary(max_size=80))
@example(content=b"\xff\xfe\x00")
@example(content=b"a: &a [*a]")
def test_anything_at_all_is_refused(content, tmp_path_factory):
    path = tmp_path_factory.mktemp("x") / "scene.yaml"
    path.write_bytes(content)
    for read in (lambda: read_scene(str(path)), lambda: read_benchmark(str(path))):
        with pytest.raises(InputError) as caught:
            read()
        one_line(caught.value)
