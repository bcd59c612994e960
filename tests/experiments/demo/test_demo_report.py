"""The report of a demonstration, without its trainings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.demo.demo_report import write_report


def test_pictures_that_cannot_be_written_are_named(tmp_path):
    pictures = {"photo": np.zeros((4, 6, 3), np.uint8), "artifact": np.ones((4, 6, 3), np.uint8)}
    demonstration: Any = SimpleNamespace(comparisons=[SimpleNamespace(name="attic", pictures=pictures)])
    (tmp_path / "sheet.png").mkdir()
    with pytest.raises(InputError, match=r"sheet\.png cannot be written"):
        write_report(demonstration, tmp_path, "ssa demo")
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]
