"""Every nerfstudio command, offline: trainings as processes of their own, the others called in this one."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.configs.method_configs import all_methods
from PIL import Image
from plyfile import PlyData

from ssa_nerfstudio.plugin.methods import METHODS  # also lets torch.load read the checkpoints, as in every command

BIN = Path(sys.executable).parent
TRAIN = ("--vis", "tensorboard", "--pipeline.model.num-downscales", "0", "--pipeline.model.stop-split-at", "1")
OFFLINE = {
    **os.environ,
    "OMP_NUM_THREADS": "1",
    "HF_HUB_OFFLINE": "1",
    "http_proxy": "http://127.0.0.1:9",
    "https_proxy": "http://127.0.0.1:9",
}
"""No download can succeed: the proxy is a port on which nothing listens."""


def command(name: str, *options: str | Path) -> subprocess.CompletedProcess:
    done = subprocess.run([BIN / name, *options], capture_output=True, text=True, timeout=300, env=OFFLINE)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done


@pytest.fixture
def call(monkeypatch):
    """Call what a command's script calls: as a process of its own it imports for ten seconds (a slow test below)."""

    def run(name: str, *options: str | Path) -> None:
        (script,) = entry_points(group="console_scripts", name=name)
        monkeypatch.setattr(sys, "argv", [name, *map(str, options)])
        script.load()()

    return run


def stopped_by(number: signal.Signals, data: Path, output: Path, steps: int) -> subprocess.CompletedProcess:
    """`ns-train` that got a signal after its first checkpoint."""
    options = ["--data", data, "--output-dir", output, "--max-num-iterations", str(steps), "--steps-per-save", "20"]
    words = [BIN / "ns-train", "ssa-splatfacto", *TRAIN, *options, "--timestamp", "stopped"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=OFFLINE)
    checkpoints = models(output, "stopped")
    deadline = time.monotonic() + 240
    while not list(checkpoints.glob("step-*.ckpt")):
        assert process.poll() is None, "the training ended before it wrote a checkpoint"
        assert time.monotonic() < deadline, "no checkpoint was written"
        time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=300)
    return subprocess.CompletedProcess(words, process.returncode, out, err)


def models(output: Path, timestamp: str) -> Path:
    """The folder of a run's checkpoints."""
    return output / "dashboard" / "ssa-splatfacto" / timestamp / "nerfstudio_models"


@pytest.fixture(scope="module")
def stopped(tiny_scene, tmp_path_factory) -> subprocess.CompletedProcess:
    return stopped_by(signal.SIGINT, tiny_scene, tmp_path_factory.mktemp("runs"), 20000)


def checkpoint_of(stopped: subprocess.CompletedProcess) -> int:
    """The step that the last line of a stopped run says to go on from."""
    return int(stopped.stderr.splitlines()[-1].partition("go on from step ")[2].partition(":")[0])


@pytest.fixture(scope="module")
def resumed(stopped) -> subprocess.CompletedProcess:
    """The command that the stopped run ended with, to step 250."""
    assert checkpoint_of(stopped) < 200, "it was stopped too late"
    words = stopped.stderr.splitlines()[-1].partition(": ns-train ")[2]
    return command("ns-train", *shlex.split(words), "--max-num-iterations", "250", "--timestamp", "resumed")


@pytest.fixture(scope="module")
def config(stopped, resumed) -> Path:
    """The configuration of the run that was resumed to its end."""
    output = Path(stopped.args[stopped.args.index("--output-dir") + 1])
    return models(output, "resumed").parent / "config.yml"


def checkpoint(config: Path) -> dict:
    return torch.load(max((config.parent / "nerfstudio_models").glob("step-*.ckpt")))


def test_ctrl_c_ends_a_training_in_one_line_with_the_command_that_resumes(stopped):
    assert stopped.returncode == 130
    assert "Traceback" not in stopped.stdout + stopped.stderr
    assert "KeyboardInterrupt" not in stopped.stdout + stopped.stderr
    line = stopped.stderr.splitlines()[-1]
    assert re.match(r"ssa-nerfstudio: stopped: at step \d+; go on from step \d+: ns-train ssa-splatfacto ", line)


def test_that_command_resumes_and_the_verdict_is_its_last_word(stopped, resumed):
    start = checkpoint_of(stopped)
    table, _, end = resumed.stdout.partition("Training Finished")
    header, *rows = [line for line in table.splitlines() if re.match(r"Step \(% Done\)|\d+ \(", line)]
    assert header.split("  ")[0] == "Step (% Done)"
    assert "Loss" in header
    assert "PSNR (dB)" in header
    assert "Rays" not in header
    assert start < int(rows[0].split()[0]) <= start + 10
    assert re.match(r"Export it: ssa export-overlay --load-config \S+ --output artifact", end.splitlines()[-1])
    assert end.splitlines()[-2].startswith("Artifact: ")
    assert "profiling" not in end


def test_a_resumed_run_goes_to_the_step_that_was_asked_for(config):
    assert checkpoint(config)["step"] == 249


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_step_that_was_asked_for(tiny_scene, tmp_path):
    stopped_by(signal.SIGKILL, tiny_scene, tmp_path, 250)
    checkpoints = models(tmp_path, "stopped")
    saved = max(int(path.stem.removeprefix("step-")) for path in checkpoints.glob("step-*.ckpt"))
    assert saved < 249
    options = ["--data", tiny_scene, "--output-dir", tmp_path, "--max-num-iterations", "250", "--timestamp", "resumed"]
    command("ns-train", "ssa-splatfacto", *TRAIN, *options, "--load-dir", checkpoints)
    assert checkpoint(models(tmp_path, "resumed").parent / "config.yml")["step"] == 249


def test_tensorboard_gets_the_artifact_as_pictures_and_figures(config):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(config.parent)).Reload()
    assert {f"Train Metrics Dict/overlay_{name}" for name in ("covered", "matte")} <= set(log.Tags()["scalars"])
    assert "Train Loss Dict/sparsity" in log.Tags()["scalars"]
    # At the steps at which losses are logged, and at no other.
    logged = [event.step for event in log.Scalars("Train Loss")]
    for name in ("Train Iter (time)", "learning_rate/means"):
        assert {event.step for event in log.Scalars(name)} == set(logged)
    for name in ("clean_and_composite", "overlay_and_matte"):
        newest = log.Images(f"Eval Images/{name}")[-1]
        assert (newest.step, newest.width, newest.height) == (200, 128, 48)
        picture = np.asarray(Image.open(io.BytesIO(newest.encoded_image_string)).convert("RGB")) / 255
        # The dashboard is at the bottom: it changes the scene there, and its matte is white.
        left, right = picture[-4:, 16:48], picture[-4:, 80:112]
        assert right.mean() > 0.8 if name == "overlay_and_matte" else np.abs(left - right).mean() > 0.05


def test_eval_writes_the_metrics_of_the_clean_render(config, call, tmp_path):
    call("ns-eval", "--load-config", config, "--output-path", tmp_path / "eval.json")
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    assert {"psnr", "ssim", "flip", "mean_color_deviation", "composite_psnr"} <= results.keys()
    assert results["psnr"] > results["composite_psnr"]


def test_render_dataset_writes_every_layer(config, call, tmp_path):
    names = ("rgb", "composite", "overlay_rgb", "overlay_alpha")
    call("ns-render", "dataset", "--load-config", config, "--output-path", tmp_path, "--rendered-output-names", *names)
    pictures = {name: np.asarray(Image.open(next((tmp_path / "test" / name).iterdir()))) for name in names}
    assert all(picture.shape[:2] == (48, 64) for picture in pictures.values())
    # ns-render draws one channel in the color map "turbo": 1 is red, 0 is blue.
    red, _, blue = np.moveaxis(pictures["overlay_alpha"].astype(int), -1, 0)
    assert (red > blue)[40:].mean() > 0.95
    assert (red < blue)[:20].mean() > 0.95
    assert np.abs(pictures["rgb"][40:].astype(int) - pictures["composite"][40:]).mean() > 10


def test_the_exported_splats_are_the_checkpoints_and_nothing_of_the_overlay(config, call, tmp_path):
    call("ns-export", "gaussian-splat", "--load-config", config, "--output-dir", tmp_path)
    vertex = PlyData.read(str(tmp_path / "splat.ply"))["vertex"]
    state = {k.removeprefix("_model.gauss_params."): v for k, v in checkpoint(config)["pipeline"].items()}
    columns = torch.cat([state[n].flatten(1) for n in ("means", "scales", "quats", "opacities", "features_dc")], dim=1)
    kept = torch.isfinite(columns).all(dim=1) & (torch.sigmoid(state["opacities"][:, 0]) >= 1 / 255)
    assert len(vertex) == int(kept.sum())
    for names, values in (
        (("x", "y", "z"), state["means"]),
        (("f_dc_0", "f_dc_1", "f_dc_2"), state["features_dc"]),
        (("opacity",), state["opacities"]),
        (("scale_0", "scale_1", "scale_2"), state["scales"]),
        (("rot_0", "rot_1", "rot_2", "rot_3"), state["quats"]),
    ):
        exported = np.stack([vertex[name] for name in names], axis=1)
        np.testing.assert_allclose(exported, values[kept].numpy(), rtol=1e-6)
    assert not [p.name for p in vertex.properties if "overlay" in p.name or "alpha" in p.name]


@pytest.mark.slow
def test_eval_render_and_export_as_processes_of_their_own(config, tmp_path):
    run = ("--load-config", config)
    command("ns-eval", *run, "--output-path", tmp_path / "eval.json")
    command("ns-render", "dataset", *run, "--output-path", tmp_path / "renders", "--rendered-output-names", "composite")
    command("ns-export", "gaussian-splat", *run, "--output-dir", tmp_path)
    assert json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"] > 10
    assert [*(tmp_path / "renders").rglob("*.jpg")]
    command(
        "ns-render", "interpolate", *run, "--output-path", tmp_path / "frames",
        "--output-format", "images", "--interpolation-steps", "2",
    )  # fmt: skip
    assert len(list((tmp_path / "frames").glob("*.jpg"))) >= 3
    assert (tmp_path / "splat.ply").stat().st_size > 1000


@pytest.mark.slow
def test_the_viewer_serves_a_trained_model(config):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    viewer = subprocess.Popen(
        [BIN / "ns-viewer", "--load-config", config, "--viewer.websocket-port", str(port)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=OFFLINE,
    )
    try:
        deadline = time.monotonic() + 200
        page = ""
        while "viser" not in page.lower():
            assert viewer.poll() is None, viewer.stdout.read()[-3000:] if viewer.stdout else ""
            assert time.monotonic() < deadline, "the viewer's page did not come up"
            time.sleep(0.5)
            try:
                page = urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5).read().decode(errors="replace")
            except OSError:
                continue
        time.sleep(2)
        assert viewer.poll() is None
    finally:
        viewer.kill()
        viewer.wait()


def test_the_readme_states_how_long_the_methods_train():
    steps = {name: METHODS[name].max_num_iterations for name in METHODS}
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    assert f"in {steps['ssa-splatfacto-fast']} steps instead of {steps['ssa-splatfacto']:,}" in readme
    assert steps["ssa-splatfacto-mcmc"] == steps["ssa-splatfacto"]
    assert steps["ssa-splatfacto-paper"] == 30_000


def test_nerfstudio_finds_the_methods():
    found = {script.name for script in entry_points(group="nerfstudio.method_configs")}
    assert found == {"ssa-splatfacto", "ssa-splatfacto-fast", "ssa-splatfacto-mcmc", "ssa-splatfacto-paper"}
    assert found <= all_methods.keys()
