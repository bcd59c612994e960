"""The documentation: every command and every option is in it, and the site builds without a warning."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from nerfstudio.scripts.downloads.download_data import nerfstudio_file_ids

from ssa_nerfstudio.cli import COMMANDS, main
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    pytest.importorskip("material", reason="mkdocs-material is not installed; pip install -e '.[dev]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-W", "ignore", "-m", "mkdocs", "build", "--strict", "--site-dir", folder]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_every_command_and_its_options_are_in_the_site(site):
    page = (site / "commands.html").read_text()
    assert all(f"<code>ssa {name}</code>" in page for name in COMMANDS)
    assert "<code>--raw-frame</code>" in page
    assert "<code>BENCHMARK</code>" in page
    assert "<code>int | None</code>" in page
    assert "*-rain-*" in page
    assert "Annotated" not in page
    assert "\\|" not in page


def test_every_setting_of_the_model_is_in_the_site(site):
    page = (site / "configuration.html").read_text()
    for name in ("overlay-given", "sparsity-weight", "cap-max", "ignore-background"):
        assert f"<code>--pipeline.model.{name}</code>" in page


def test_equations_are_drawn_by_the_browser_alone(site):
    page = (site / "method.html").read_text()
    equations = re.findall(r"<math.*?</math>", page, re.DOTALL)
    assert sum('display="block"' in equation for equation in equations) >= 7
    assert not [equation for equation in equations if "\\" in equation], "LaTeX that was not understood"
    assert "$`" not in page
    assert "language-math" not in page


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_module_that_a_page_names_exists(page):
    named = re.findall(r"`((?:\w+/)+(?:\w+\.(?:py|yaml))?)`", page.read_text())
    ours = [name for name in named if (ROOT / "ssa_nerfstudio" / name.split("/")[0]).exists() or name.endswith(".py")]
    assert [name for name in ours if not any((root / name).exists() for root in (ROOT, ROOT / "ssa_nerfstudio"))] == []
    modules = re.findall(r"python -m (ssa_nerfstudio(?:\.\w+)+)", page.read_text())
    assert [name for name in modules if not (ROOT / (name.replace(".", "/") + ".py")).exists()] == []
    scripts = re.findall(r"python ((?:benchmarks|docs|tests)/[\w/]+\.py)", page.read_text())
    assert [name for name in scripts if not (ROOT / name).exists()] == []


ARCHITECTURE = (ROOT / "docs/architecture.md").read_text()


def test_the_architecture_page_names_every_folder():
    package = ROOT / "ssa_nerfstudio"
    folders = {f"`{p.name}/`" for p in package.iterdir() if (p / "__init__.py").exists()}
    folders |= {f"`{p.name}`" for p in package.glob("*.py") if not p.name.startswith("__")}
    assert [folder for folder in sorted(folders) if folder not in ARCHITECTURE] == []


def test_the_architecture_page_names_what_its_modules_define():
    places = re.findall(r"((?:`\w+`(?:,| and| or) )*`\w+`)\s+in\s+`([\w/]+\.py)`", ARCHITECTURE)
    assert len(places) >= 6
    for names, module in places:
        source = (ROOT / "ssa_nerfstudio" / module).read_text()
        for name in re.findall(r"`(\w+)`", names):
            assert re.search(rf"^(?:class |def )?{name}\b", source, re.MULTILINE), f"{module} defines no {name}"


def test_the_diagram_of_imports_is_up_to_date():
    pytest.importorskip("grimp", reason="import-linter is not installed; pip install -e '.[dev]'")
    command = [sys.executable, "docs/import_diagram.py", "--check"]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_a_page_links_exists(page):
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[\w-]*)?\)", page.read_text())
    assert [link for link in links if not (page.parent / link).exists()] == []


def flag(field: dataclasses.Field) -> str:
    named = re.search(r'arg\(name=[\'"](\w+)', str(field.type))
    return named[1] if named else field.name.replace("_", "-")


def options(name: str) -> set[str]:
    """Names of a command's options."""
    command = importlib.import_module(f"ssa_nerfstudio.cli.{name.replace('-', '_')}").Command
    return {flag(field) for field in dataclasses.fields(command)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_option_that_a_page_shows_exists(page):
    text = page.read_text().replace("\\\n", " ")
    for name, line in re.findall(r"\bssa ([a-z][a-z-]*)\b([^\n`]*)", text):
        if name in COMMANDS:
            known = options(name) | {"help"}
            if name == "run":
                known |= {f"{stage}.{option}" for stage in ("detect", "process") for option in options(stage)}
            shown = re.findall(r"(?<!\S)--(?!train\.)([a-z.-]+)", line.split("#")[0])
            assert [option for option in shown if not {option, option.removeprefix("no-")} & known] == [], line
    settings = {field.name for field in dataclasses.fields(SSASplatfactoModelConfig)}
    shown = re.findall(r"--pipeline\.model\.([a-z][a-z-]*)", text)
    assert [name for name in shown if name.replace("-", "_") not in settings] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_capture_that_a_page_names_can_be_downloaded(page):
    named = re.findall(r"ns-download-data nerfstudio --capture-name ([\w-]+)", page.read_text())
    assert [name for name in named if name not in nerfstudio_file_ids] == []


def test_the_site_fetches_nothing_from_the_internet(site):
    for page in site.glob("*.html"):
        assert 'src="http' not in page.read_text()


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_explains_every_option(name, capsys):
    with pytest.raises(SystemExit) as caught:
        main([name, "--help"])
    assert caught.value.code == 0
    text = capsys.readouterr().out
    command = importlib.import_module(f"ssa_nerfstudio.cli.{name.replace('-', '_')}").Command
    for field in dataclasses.fields(command):
        if "tyro.conf.Suppress" in str(field.type):
            continue
        # An argument without a flag is called by its name in capitals.
        assert "--" + flag(field) in text or field.name.upper() in text
