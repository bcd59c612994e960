"""What an earlier run left is taken where it was made from the same, and only there."""

from __future__ import annotations

import pytest

from ssa_nerfstudio.sfm.work_folder import resumable_work


@pytest.mark.parametrize(
    ("inputs", "kept"),
    [
        ({"threads": 2, "photos": ["a", "b"]}, True),
        ({"photos": ["a", "b"], "threads": 2}, True),
        ({"photos": ["b", "a"], "threads": 2}, False),
        ({"photos": ["a", "b"], "threads": 3}, False),
        (None, False),
    ],
)
def test_work_is_continued_from_the_same_inputs_alone(inputs, kept, tmp_path):
    with resumable_work(tmp_path / "out") as work:
        (work.subfolder("motion", {"photos": ["a", "b"], "threads": 2}) / "features").write_text("found")
    with resumable_work(tmp_path / "out") as work:
        assert [path.name for path in work.subfolder("motion", inputs).iterdir()] == ["features"] * kept
