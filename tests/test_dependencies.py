"""What the package imports is what pyproject.toml declares: the product's packages, and those of the extra."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

ROOT = Path(__file__).parents[1]
OPTIONAL = {
    "triton": "comes with torch for CUDA",
    "pillow_heif": "the extra heic",
    "pydantic_core": "comes with pydantic",
    "markupsafe": "comes with jinja2",
    "diffusers": "the extra diffusion",
}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def declared() -> tuple[set[str], set[str]]:
    """Distributions that the package requires, and those of the extra `experiments`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extra = project["optional-dependencies"]["experiments"]
    both = [{canonical(re.split(r"[<>=!~ ;\[]", line, maxsplit=1)[0]) for line in lines} for lines in
            (project["dependencies"], extra)]  # fmt: skip
    return both[0], both[1]


def imported(path: Path) -> Iterator[str]:
    """Top-level packages that a module imports anywhere, ours and Python's own left out."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names = [node.module]
        for name in names:
            top = name.split(".")[0]
            if top != "ssa_nerfstudio" and top not in sys.stdlib_module_names:
                yield top


@pytest.mark.parametrize("part", ["product", "experiments"])
def test_every_package_that_is_imported_is_declared(part):
    product, extra = declared()
    allowed = product if part == "product" else product | extra
    distributions = packages_distributions()
    for path in (ROOT / "ssa_nerfstudio").rglob("*.py"):
        if ("experiments" in path.parts) == (part == "experiments"):
            for name in {*imported(path)} - OPTIONAL.keys():
                found = {canonical(distribution) for distribution in distributions[name]}
                assert found & allowed, (
                    f"{path.relative_to(ROOT)} imports {name}, which pyproject.toml does not declare"
                )


def test_importing_the_package_is_light():
    heavy = {"torch", "numpy", "nerfstudio", "gsplat", "cv2", "PIL", "rich", "tyro"}
    code = f"import sys, ssa_nerfstudio, ssa_nerfstudio.cli; print(sorted({heavy!r} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_the_public_face_is_complete():
    code = "import ssa_nerfstudio as s; print(all(getattr(s, name) is not None for name in s.__all__), hasattr(s, 'x'))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "True False"
