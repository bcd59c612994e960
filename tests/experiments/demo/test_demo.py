"""`ssa demo` as a newcomer runs it: what it prints and writes."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow


def demo(*arguments: object) -> str:
    command = [sys.executable, "-m", "ssa_nerfstudio", "demo", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "" not in done.stdout.splitlines()[:2], "there is an empty line where a bar would be"
    return " ".join(done.stdout.split())


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Folder and console of a demonstration of a few steps."""
    folder = tmp_path_factory.mktemp("demo")
    return folder, demo("--output", folder, "--steps", 12)


def test_it_compares_both_methods_behind_a_dashboard_and_a_watermark(shown):
    folder, console = shown
    results = json.loads((folder / "results.json").read_text())
    assert set(results["datasets"]) == {"dashboard", "watermark"}
    for method in ("overlay-off", "ssa-splatfacto"):
        assert results[method] == results["datasets"]["dashboard"][method]
        assert results[method]["psnr"] > 5
        assert "composite_psnr" not in results[method]
        assert 0 < results[method]["ssim"] < 1
        assert 0 < results[method]["flip"] < 1
        assert results[method]["seconds"] > 0
        assert f"{results[method]['psnr']:.2f}" in console
    assert results["clean_test_views"]
    assert (folder / "sheet.png").stat().st_size > 10_000
    assert "<img" in (folder / "report.html").read_text()


def test_on_photos_of_ones_own_it_says_that_there_are_no_clean_ones(shown, tmp_path):
    data = shown[0] / "demo-data" / "watermark"
    transforms = json.loads((data / "transforms.json").read_text())
    named = [key for key in transforms if key.endswith("_filenames")]
    transforms = {key: value for key, value in transforms.items() if key not in named}
    (data / "transforms.json").write_text(json.dumps(transforms))
    console = demo("--output", tmp_path, "--data", data, "--steps", 8, "--scale-factor", 0.5)
    assert not json.loads((tmp_path / "results.json").read_text())["clean_test_views"]
    assert "corrupted" in console
