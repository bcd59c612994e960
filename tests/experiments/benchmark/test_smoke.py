"""`ssa bench smoke`, killed half-way and resumed, `ssa report`, `ssa tradeoff`: real processes, real training."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from conftest import at_work
from PIL import Image

from ssa_nerfstudio.experiments.benchmark.results import read_all

pytestmark = pytest.mark.slow

SSA = (sys.executable, "-m", "ssa_nerfstudio")
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
DEADLINE = 400.0


def ssa(*arguments: str | Path) -> str:
    done = subprocess.run([*SSA, *arguments], capture_output=True, text=True, timeout=DEADLINE, env=ENVIRONMENT)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> tuple[Path, dict[Path, bytes]]:
    """A benchmark that was killed when its first results were there, and those results."""
    folder = tmp_path_factory.mktemp("smoke")
    process = subprocess.Popen(
        [*SSA, "bench", "smoke", "--output", folder, "--runs-per-device", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=ENVIRONMENT,
    )
    deadline = time.monotonic() + DEADLINE
    while not list(folder.glob("results/*.json")) or not list(folder.glob("running/*/progress")):
        assert process.poll() is None, "the benchmark ended before it could be killed"
        assert time.monotonic() < deadline, "no run ended"
        time.sleep(0.1)
    assert len(at_work(folder)) > 1
    process.send_signal(signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 120  # numba compiles for seconds without letting go of the interpreter
    while at_work(folder):
        assert time.monotonic() < deadline, "its runs go on"
        time.sleep(0.1)
    return folder, {path: path.read_bytes() for path in folder.glob("results/*.json")}


@pytest.fixture(scope="module")
def resumed(killed) -> Path:
    """The same benchmark called again."""
    folder, _ = killed
    ssa("bench", "smoke", "--output", folder, "--runs-per-device", "2")
    return folder


def test_a_killed_benchmark_takes_its_runs_along(killed):
    folder, before = killed
    assert 0 < len(before) < 5
    assert {path: path.read_bytes() for path in folder.glob("results/*.json")} == before


def test_a_resumed_benchmark_repeats_nothing_and_finishes_the_rest(killed, resumed):
    _, before = killed
    assert {path: path.read_bytes() for path in before} == before
    results, problems = read_all([resumed])
    assert problems == []
    assert [result.status for result in results] == ["finished"] * 5, [result.reason for result in results]
    assert list((resumed / "running").iterdir()) == []
    assert "All smoke runs" in ssa("bench", "smoke", "--output", resumed)


def test_the_overlay_restores_what_the_dashboard_hid(resumed):
    dashboard = {
        r.run.method: r for r in read_all([resumed])[0] if r.run.effect == "dashboard" and r.run.densification == "adc"
    }
    psnr: dict[str, Any] = {method: result.metrics["psnr"] for method, result in dashboard.items()}
    assert psnr["default"] > psnr["3dgs"] + 1
    assert psnr["given"] > psnr["3dgs"] + 1
    assert dashboard["default"].artifact["matte_iou"] > 0.9
    assert dashboard["default"].artifact["matte_error"] < 0.1
    assert dashboard["given"].artifact == dashboard["3dgs"].artifact == {}


def test_a_result_tells_all_that_it_depends_on(resumed):
    for result in read_all([resumed])[0]:
        assert len(result.views) == 4
        views: list[Any] = [view["psnr"] for view in result.views.values()]
        assert result.metrics["psnr"] == pytest.approx(sum(views) / 4)
        assert all(seconds >= 0 for seconds in result.seconds.values())
        learned = result.run.method in ("default", "overlay-on")
        assert (result.seconds["statistics"] > 0) >= learned
        assert not result.alone
        assert result.company["runs_per_device"] == 2
        assert result.gaussians > 0
        assert result.peak_memory_mb > 0
        assert {"torch", "gsplat", "nerfstudio", "device"} <= result.versions.keys()
        assert result.command.startswith("ssa bench smoke --output")
        assert result.command.endswith(result.run.id)
        assert result.schedules["factor"] == 100 / 30000
        assert result.schedules["learning_rate_means"] == 100


def test_the_report_shows_every_method_and_names_a_file_that_is_no_result(resumed):
    results = resumed / "results"
    (results / "notes.json").write_text("{}")
    shown = ssa("report", resumed)
    (results / "notes.json").unlink()
    assert "notes.json is not a result" in shown
    text = (resumed / "report" / "report.md").read_text()
    assert "5 finished" in text
    assert "notes.json" in text
    for title in ("3DGS", "SSA, default", "oracle overlay", "Clean (Ref)", "Dashboard"):
        assert title in text
    page = (resumed / "report" / "report.html").read_text()
    assert page.count("<img") == page.count("data:image/jpeg;base64,") == 3
    with Image.open(resumed / "report" / "sheets" / "demo-dashboard-adc-100-e0.jpg") as sheet:
        assert sheet.width > 1000


@pytest.mark.slow
def test_the_tradeoff_draws_every_point_with_its_command(tmp_path, killed):
    folder, _ = killed
    (tmp_path / "scenes").symlink_to(folder / "scenes")  # made by the benchmark
    shown = ssa("tradeoff", "smoke", "--output", tmp_path, "--runs-per-device", "2")
    assert "on no frontier" in shown
    with (tmp_path / "tradeoff" / "tradeoff.csv").open() as file:
        points = list(csv.DictReader(file))
    assert len(points) == 3 * 3
    assert {point["setting"] for point in points} == {"base", "steps 50", "steps 50, overlay_downscale 2"}
    for setting in {point["setting"] for point in points}:
        curve = [point for point in points if point["setting"] == setting]
        assert [float(p["seconds"]) for p in curve] == sorted(float(p["seconds"]) for p in curve)
        assert float(curve[-1]["psnr"]) > float(curve[0]["psnr"])
    assert all(point["command"].startswith("ssa tradeoff smoke --output") for point in points)
    assert {point["alone"] for point in points} == {point["on_frontier"] for point in points} == {"0"}
    with Image.open(tmp_path / "tradeoff" / "demo-dashboard-cpu.png") as figure:
        assert figure.width > 1000
    assert "<svg" in (tmp_path / "tradeoff" / "demo-dashboard-cpu.svg").read_text()
    assert json.loads(next((tmp_path / "plans").glob("tradeoff-smoke.json")).read_text())["runs"]
