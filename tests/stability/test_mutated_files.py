"""transforms.json with something wrong in it at random: it is read, or refused in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mutations import OFTEN, mutated, one_line

from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.training_requirements import check_training
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, write_built_in_scene) -> Path:
    folder = tmp_path_factory.mktemp("mutated") / "dataset"
    return write_built_in_scene(folder, views=6, test_views=2, width=16, height=12)


@OFTEN
@given(data=st.data())
def test_transforms_are_read_or_refused(data, dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("t") / "d"
    shutil.copytree(dataset, folder)
    original = json.loads((dataset / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps(mutated(original, data.draw)))
    for check in (lambda: check_training(Transforms.read(folder)), lambda: Dataset.read(folder, 8)):
        try:
            check()
        except InputError as refused:
            one_line(refused)
    shutil.rmtree(folder)


@settings(max_examples=50, deadline=None)
@given(content=st.binary(max_size=80))
@example(content=b"[" * 80)
def test_anything_at_all_is_refused(content, tmp_path_factory):
    path = tmp_path_factory.mktemp("x") / "transforms.json"
    path.write_bytes(content)
    for read in (lambda: check_training(Transforms.read(path.parent)), lambda: Dataset.read(path.parent, 8)):
        with pytest.raises(InputError) as caught:
            read()
        one_line(caught.value)
