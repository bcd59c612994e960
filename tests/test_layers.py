"""The layers that pyproject.toml states hold, and the linter notices an import that points up."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PRODUCT_SHARE = 0.65
MAX_LINES = 300
BASELINES = ROOT / "ssa_nerfstudio" / "experiments" / "benchmark" / "baselines"
MAX_BASELINE_LINES = 200


def lint(folder: Path) -> subprocess.CompletedProcess:
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(ROOT / "ssa_nerfstudio", folder / "ssa_nerfstudio", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def test_every_import_points_down(copy):
    done = lint(copy)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("overlay/layer.py", "import ssa_nerfstudio.plugin.settings", "Imports point down"),
        ("plugin/pipeline.py", "import ssa_nerfstudio.experiments.configuration", "Only cli and experiments"),
        ("plugin/settings.py", "import ssa_nerfstudio.plugin.model", "No cycles"),
        ("sfm/image_pairs.py", "import nerfstudio.cameras", "import nerfstudio"),
        ("data/transforms.py", "import torch", "No torch"),
    ],
)
def test_one_import_that_points_up_breaks_the_lint(copy, module, line, contract):
    path = copy / "ssa_nerfstudio" / module
    source = path.read_text()
    path.write_text(f"{source}\n{line}\n")
    try:
        done = lint(copy)
    finally:
        path.write_text(source)
    assert done.returncode != 0
    assert contract in done.stdout.split("Broken contracts")[1]


def test_the_product_is_most_of_the_package_and_no_module_is_large():
    lines = {path: len(path.read_text().splitlines()) for path in (ROOT / "ssa_nerfstudio").rglob("*.py")}
    assert [path for path, count in lines.items() if count >= MAX_LINES] == []
    # Not counted: each is another paper's method, a module that nothing else needs, and bounded by itself.
    baselines = {path: lines.pop(path) for path in BASELINES.glob("*.py")}
    assert [path for path, count in baselines.items() if count > MAX_BASELINE_LINES] == []
    experiments = sum(count for path, count in lines.items() if "experiments" in path.parts)
    assert 1 - experiments / sum(lines.values()) > PRODUCT_SHARE


def test_no_two_modules_share_a_name():
    names = [path.stem for path in (ROOT / "ssa_nerfstudio").rglob("*.py") if path.stem not in ("__init__", "__main__")]
    assert sorted(names) == sorted(set(names))
