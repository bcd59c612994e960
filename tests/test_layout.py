"""Tests of the product take the experiments from the fixtures of conftest.py, so that both can be told apart."""

from __future__ import annotations

from pathlib import Path

import pytest

TESTS = Path(__file__).parent
OTHERS = {
    "experiments",
    "benchmarks",
    "cli",
    "docs",
    "bare_install",
    "conftest.py",
    "test_layers.py",
    Path(__file__).name,
}
"""What is no test of the product alone."""
PRODUCT = sorted(path for path in TESTS.rglob("*.py") if path.relative_to(TESTS).parts[0] not in OTHERS)


@pytest.mark.parametrize("path", PRODUCT, ids=lambda path: str(path.relative_to(TESTS)))
def test_the_product_is_tested_without_importing_the_experiments(path):
    # The text, not the syntax tree: programs in strings count, too.
    assert "ssa_nerfstudio.experiments" not in path.read_text(encoding="utf-8")


def test_what_is_checked_is_every_folder_of_the_product():
    folders = {path.relative_to(TESTS).parts[0] for path in PRODUCT}
    assert {"overlay", "evidence", "cameras", "data", "sfm", "export", "plugin", "rasterization", "metrics"} <= folders
