"""`ssa run` as a user runs it: from photos, from a dataset, stopped and continued."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from gsply import plyread
from PIL import Image
from small_captures import HEIGHT, WIDTH, write

from benchmarks import viewer_screenshots
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.workflow import photos_to_splats

VIEWS = 16


def run(*options: object) -> None:
    main(["run", *map(str, options)])


def results(output: Path) -> dict[str, str]:
    """What came out of each stage."""
    record = json.loads((output / "run.json").read_text())
    return {name: stage["done"]["text"] for name, stage in record.items()}


@pytest.fixture(scope="module")
def covered(tmp_path_factory, photos, draw_effect) -> Path:
    """Photos behind a dashboard, in a folder whose name a shell has to quote."""
    layers = draw_effect("dashboard", HEIGHT, WIDTH)
    return write(tmp_path_factory.mktemp("capture") / "my photos", [layers.apply(photo) for photo in photos(VIEWS)])


@pytest.fixture(scope="module")
def finished(covered) -> Path:
    """A run that was killed while it trained, and then finished by the same command."""
    output = covered.parent / "out"
    options = [covered, "--output", output, "--steps", "120", "--process.threads", "1"]
    command = [sys.executable, "-m", "ssa_nerfstudio", "run", *map(str, options)]
    with (covered.parent / "screen.txt").open("wb") as screen:
        process = subprocess.Popen(command, stdout=screen, env={**os.environ, "OMP_NUM_THREADS": "1"})
    try:
        deadline = time.monotonic() + 200
        while not list(output.glob("training/*/nerfstudio_models/step-*.ckpt")):
            assert process.poll() is None, "ended before its first checkpoint"
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        process.kill()
        process.wait()
    run(*options)
    return output


def test_it_continues_where_it_was_killed(finished):
    stages = results(finished)
    assert list(stages) == ["detect", "process", "train", "evaluate", "export"]
    learned = r"the artifact was learned .*, in 120 steps \(continued at step \d+; the time is since then\)"
    assert re.match(learned, stages["train"])
    assert stages["process"].startswith(f"{VIEWS} of {VIEWS} photos have poses")


def test_structure_from_motion_masks_what_the_first_stage_found(finished):
    assert results(finished)["process"].endswith("; found without the artifact's pixels")
    used = np.asarray(Image.open(finished / "dataset/mask_colmap.png"))
    found = np.asarray(Image.open(finished / "detection/mask_colmap.png"))
    assert not used[found == 0].any()
    assert used[found > 0].mean() > 0.9


def test_what_training_decided_before_it_was_killed_is_on_the_screen_and_the_page(finished):
    verdict = "The photos have a static artifact: training with an overlay"  # how much, the first stage has said
    assert re.search(verdict, " ".join((finished.parent / "screen.txt").read_text().split()))
    assert len(re.findall(f"<li>{verdict}", (finished / "report.html").read_text())) == 1


@pytest.mark.parametrize("stage", ["detect", "process", "train", "evaluate", "export"])
def test_a_stage_that_was_killed_before_it_was_recorded_is_made_good(finished, covered, stage):
    """Its files are there, in whole or in part, but the record does not have it."""
    record, files = finished / "run.json", {path: path.read_bytes() for path in finished.glob("*.p*")}
    contents = json.loads(record.read_text())
    before, contents[stage]["done"] = contents[stage]["done"], {}
    record.write_text(json.dumps(contents))
    (finished / ".evaluation.left").mkdir()
    run(covered, "--output", finished, "--steps", "120", "--process.threads", "1")
    after = json.loads(record.read_text())
    assert {name for name in after if after[name]["done"]} == set(contents)
    if stage != "train":  # which says that it was continued
        assert {**after[stage]["done"], "seconds": 0} == {**before, "seconds": 0}
    assert {path: path.read_bytes() for path in finished.glob("*.p*")} == files
    assert (finished / ".evaluation.left").exists() == (stage != "evaluate")
    shutil.rmtree(finished / ".evaluation.left", ignore_errors=True)


def test_the_splats_are_those_of_the_training(finished):
    config = finished / "training/ssa-splatfacto/config.yml"
    main(["export-splats", "--load-config", str(config), "--output-dir", str(finished / "again"), "--compressed"])
    assert (finished / "splats.ply").read_bytes() == (finished / "again/splat.ply").read_bytes()
    count = len(plyread(str(finished / "splats.ply")).means)
    assert len(plyread(str(finished / "splats-compressed.ply")).means) == count


def test_the_artifact_covers_what_the_dashboard_covers(finished, draw_effect):
    matte = np.asarray(Image.open(finished / "matte.png")) / 255
    assert np.array_equal(np.asarray(Image.open(finished / "artifact.png"))[..., 3], np.rint(matte * 255))
    hidden = draw_effect("dashboard", HEIGHT, WIDTH).transmittance.min(axis=-1) < 0.05
    hidden = np.asarray(Image.fromarray(hidden).resize((matte.shape[1], matte.shape[0]))) > 0
    assert matte[hidden].mean() > 0.8
    assert matte[~hidden].mean() < 0.3


def test_the_page_shows_all_and_names_no_folder_of_this_machine(finished):
    page = (finished / "report.html").read_text()
    assert str(finished.parent) not in page
    assert page.count("data:image/jpeg;base64,") == 2
    assert page.count("data:image/png;base64,") == 2
    assert "a static artifact over" in page
    assert 'href="splats.ply"' in page
    assert "They carry the artifact, too" in page
    assert "without a GPU" not in page, "120 steps were asked for, and the photos are small"


def test_the_commands_on_the_page_work_in_its_folder(finished):
    page = (finished / "report.html").read_text()
    commands = re.findall(r"<pre>(.*?)</pre>", page)
    assert [command.split()[:2] for command in commands if command.startswith("ssa")] == [
        ["ssa", "detect"], ["ssa", "process"], ["ssa", "export-splats"], ["ssa", "export-dataset"],
        ["ssa", "export-overlay"],
    ]  # fmt: skip
    (detect,) = [command for command in commands if "ssa detect" in command]
    assert "&#39;../my photos&#39;" in detect
    shell = detect.replace("&#39;", "'").replace("ssa ", f"{sys.executable} -m ssa_nerfstudio ", 1)
    done = subprocess.run(shell, shell=True, cwd=finished, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (finished / "again/detection/evidence.png").is_file()
    assert any(command.endswith("again/dataset --detect --threads 1") for command in commands)
    (train,) = [command for command in commands if command.startswith("ns-train")]
    assert train == "ns-train ssa-splatfacto --data dataset --output-dir again --max-num-iterations 120"


def test_a_dataset_whose_test_photos_are_clean_and_options_of_its_stages(tiny_scene, tmp_path):
    run(
        tiny_scene, "--output", tmp_path / "out", "--steps", 8, "--detect.draws", 300,
        "--train.pipeline.model.overlay", "off", "--train.nerfstudio-data.eval-mode", "filename",
    )  # fmt: skip
    out = tmp_path / "out"
    stages = results(out)
    assert list(stages) == ["detect", "train", "evaluate", "export"]
    assert "the scene alone" in stages["train"]
    assert stages["evaluate"].startswith("PSNR of 3 photos")
    assert not (out / "artifact.png").exists()
    page = (out / "report.html").read_text()
    assert "carry the artifact" not in page
    assert "nerfstudio-data --eval-mode filename" in page
    assert "--draws 300" in page


def test_a_missed_artifact_is_told_of_before_the_first_step(tiny_scene, tmp_path, monkeypatch, capsys):
    def stop(plan: object, artifacts: Artifacts) -> None:
        raise InputError(f"there are overlays {[artifacts.name(group) for group in range(len(artifacts))]}")

    monkeypatch.setattr(photos_to_splats, "warn_of_missed_artifacts", stop)
    with pytest.raises(SystemExit):
        run(tiny_scene, "--output", tmp_path / "out", "--steps", 8)
    assert "there are overlays ['camera_0']" in capsys.readouterr().err
    assert not list(tmp_path.glob("out/training/*/nerfstudio_models/*"))


@pytest.mark.browser
def test_the_page_fits_a_narrow_window_and_its_line_can_be_moved(finished):
    if viewer_screenshots.find_chromium() is None:
        pytest.skip("no Chromium on this machine; Debian: apt install chromium")
    pytest.importorskip("playwright.sync_api", reason="no playwright; pip install playwright")
    with viewer_screenshots.browser() as browser:
        page = browser.new_page(viewport={"width": 360, "height": 700})
        page.goto((finished / "report.html").as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        splats = page.get_by_alt_text("the same view, splats alone")
        shown = "image => getComputedStyle(image).clipPath"
        assert splats.evaluate(shown) == "inset(0px 0px 0px 50%)"
        page.get_by_label("photo or splats").fill("20")
        assert splats.evaluate(shown) == "inset(0px 0px 0px 20%)"
        assert all(page.evaluate("[...document.images].map(image => image.naturalWidth > 0)"))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--steps", "0"], "--steps must be at least 1"),
        (["--detect.draws", "3"], "--detect.draws must be at least 200"),
        (["--train.pipeline.model.overlay", "maybe"], "(ns-train ssa-splatfacto --help)"),
        (["--train.no-such-option", "1"], "Unrecognized options: --train.no-such-option"),
        (["--nonsense", "1"], "Unrecognized options: --nonsense"),
        (
            ["--pipeline.model.overlay", "on"],
            "given as --detect.NAME, --process.NAME, --train.NAME",
        ),
        (["--photos", "there"], "ssa run PHOTOS --output OUT"),
        (["--process.matching", "sequential"], "--process.matching: "),
    ],
)
def test_wrong_options_end_before_any_work(tiny_scene, tmp_path, capsys, options, expected):
    with pytest.raises(SystemExit) as caught:
        run(tiny_scene, "--output", tmp_path / "out", *options)
    assert caught.value.code == 2
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_its_help_says_that_options_of_the_stages_are_passed_on(capsys):
    with pytest.raises(SystemExit) as caught:
        run("--help")
    assert caught.value.code == 0
    told = capsys.readouterr().out
    assert all(f"--{stage}.NAME" in told for stage in ("detect", "process", "train"))


def test_a_folder_of_something_else_is_left_alone(tiny_scene, tmp_path, capsys):
    (tmp_path / "holiday.jpg").touch()
    for output, expected in ((tmp_path, "exists and is no run"), (tmp_path / "holiday.jpg", "is a file")):
        with pytest.raises(SystemExit) as caught:
            run(tiny_scene, "--output", output)
        assert caught.value.code == 2
        assert expected in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]


def test_options_of_structure_from_motion_are_checked_too(covered, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run(covered, "--output", tmp_path / "out", "--process.matching", "all")
    assert "invalid choice 'all' for argument '--process.matching'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_rig_of_two_cameras_gets_an_overlay_each(tmp_path, photos, draw_effect):
    """A folder for each camera; the side camera's frame is narrower, and its panel is at the top."""
    capture = tmp_path / "rig"
    dashboard = draw_effect("dashboard", HEIGHT, WIDTH)
    views = photos(2 * VIEWS)
    side = [view[:, 16:-16].copy() for view in views[1::2]]
    panel = np.kron(np.random.default_rng(0).integers(0, 256, (6, 32, 1)), np.ones((6, 6, 3)))
    for view in side:
        view[: len(panel)] = panel
    write(capture / "front", [dashboard.apply(view) for view in views[::2]])
    write(capture / "side", side)
    out = tmp_path / "out"
    run(capture, "--output", out, "--steps", 60, "--process.threads", 1)
    stages = results(out)
    assert stages["detect"].startswith("front: a static artifact over")
    assert "side: a static artifact over" in stages["detect"]
    assert stages["process"].startswith(f"{2 * VIEWS} of {2 * VIEWS} photos have poses")
    assert stages["train"].startswith("the artifacts of 2 cameras were learned")
    front, top = (np.asarray(Image.open(out / f"matte-{name}.png")) / 255 for name in ("front", "side"))
    assert abs(front.shape[1] - top.shape[1] - 32) <= 2
    assert front[-20:].mean() > 0.8 > 0.2 > front[:20].mean()
    assert top[4:28].mean() > 0.8 > 0.2 > top[-40:].mean()
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 4
    assert "<h2>side</h2>" in page
    config = str(out / "training/ssa-splatfacto/config.yml")
    main(["export-dataset", "--for", "colmap", "--load-config", config, "--output", str(tmp_path / "masked")])
    masks = sorted((tmp_path / "masked/masks").iterdir())
    assert [path.name for path in masks[:: len(masks) - 1]] == ["front_00001.png.png", "side_00016.png.png"]
    assert np.asarray(Image.open(masks[-1]))[4:28].mean() < 0.1 * 255


def test_structure_from_motion_that_failed_continues_with_another_requirement(tmp_path, capsys):
    """Its work is kept, and so is the folder of the run."""
    rng = np.random.default_rng(0)
    capture = write(tmp_path / "noise", [rng.integers(0, 256, (48, 64, 3), dtype=np.uint8) for _ in range(4)])
    for share in ("0.5", "0.25"):
        with pytest.raises(SystemExit):
            run(capture, "--output", tmp_path / "out", "--process.threads", 1, "--process.min-registered", share)
        assert f"{float(share):.0%} are required" in capsys.readouterr().err
    assert (tmp_path / "out/.dataset.work/motion/database.db").exists()
