"""docs/api.md is a program that runs: its blocks, in order, on a tiny scene and with few steps."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

PAGE = Path(__file__).parents[2] / "docs/api.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)


def replace_once(program: str, old: str, new: str) -> str:
    assert program.count(old) == 1, f"docs/api.md no longer says {old!r}"
    return program.replace(old, new)


@pytest.fixture(scope="module")
def names(tiny_scene, tmp_path_factory) -> dict[str, object]:
    """Names that the page's program leaves behind."""
    program = "\n".join(BLOCKS)
    program = replace_once(program, 'Path("outputs/demo/demo-data/dashboard")', f"Path({str(tiny_scene)!r})")
    program = replace_once(program, 'Path("runs")', f"Path({str(tmp_path_factory.mktemp('runs'))!r})")
    program = replace_once(program, "max_num_iterations = 800", "max_num_iterations = 20")
    names: dict[str, object] = {}
    exec(compile(program, PAGE.name, "exec"), names)
    return names


def test_the_program_is_short():
    lines = [line for block in BLOCKS for line in block.splitlines() if line.strip()]
    assert len(lines) <= 40


def test_detection_finds_the_dashboard(names):
    assert names["camera"] == "camera_0"
    assert names["found"].verdict == "opaque"
    assert names["found"].mask.shape == (48, 64)


def test_training_leaves_a_run(names):
    assert names["run"].is_file()
    assert list(names["run"].parent.glob("nerfstudio_models/*.ckpt"))


def test_the_overlay_restores_what_it_was_laid_over(names):
    opaque = (names["T"] < 0.05)[..., 0]
    assert names["T"].shape == (48, 64, 1)
    assert opaque.any()
    torch.testing.assert_close(names["restored"][~opaque], names["clean"][~opaque], atol=1e-4, rtol=0)
    assert not torch.allclose(names["corrupted"], names["clean"], atol=0.1)


def test_bad_input_is_an_exception_with_a_remedy(names, capsys):
    ssa = names["ssa"]
    with pytest.raises(ssa.InputError) as caught:
        ssa.detect("no-such-folder")
    assert caught.value.problem
    assert caught.value.remedy
    assert capsys.readouterr().out == ""
