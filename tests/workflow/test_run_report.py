"""The page of a run: each camera with its own artifact, and what there is only after some trainings."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from ssa_nerfstudio.workflow.finished_training import Evaluation, PicturedGroup
from ssa_nerfstudio.workflow.run_report import report_page
from ssa_nerfstudio.workflow.stages import FinishedStage

STAGES = [FinishedStage(name, 1.0, name) for name in ("detect", "train")]


def page_of(folder: Path, overlays: list[str | None], artifacts: list[str], on_sphere: bool = False) -> str:
    """The page of a run of as many cameras as there are overlays, each with an artifact of another color."""
    (folder / "evaluation").mkdir()
    for number in range(1, len(overlays) + 1):
        for kind in ("photo", "clean"):
            Image.new("RGB", (8, 6)).save(folder / f"evaluation/{kind}-{number}.jpg")
    for name in artifacts:
        Image.new("RGBA", (8, 6), (len(name), 0, 0, 255)).save(folder / f"artifact{name}.png")
        Image.new("L", (8, 6), len(name)).save(folder / f"matte{name}.png")
    for name in ("splats.ply", "splats-compressed.ply"):
        (folder / name).touch()
    metrics = {"psnr": 20.0, "cc_psnr": 23.25, "ssim": 0.9, "flip": 0.1}
    pictured = [PicturedGroup(f"number {number}", name) for number, name in enumerate(overlays, 1)]
    Evaluation(metrics, {}, True, pictured).write(folder / "evaluation")
    return report_page(folder, "drive", STAGES, {}, on_sphere)


def shown(page: str, picture: Path) -> int:
    """In the part of which camera a picture is embedded, from 1."""
    before, _ = page.split(base64.b64encode(picture.read_bytes()).decode(), 1)
    return before.count("<h2>number ")


@pytest.mark.parametrize("overlays", [[None, "a"], ["a", None], [None, None, "a"]])
def test_the_only_artifact_is_shown_with_its_camera(tmp_path, overlays):
    page = page_of(tmp_path, overlays, [""])
    assert shown(page, tmp_path / "artifact.png") == overlays.index("a") + 1
    assert page.count("The artifact, over a checkerboard") == 1
    assert "in all directions" not in page


def test_artifacts_are_not_mixed_up(tmp_path):
    page_of(tmp_path, ["2", None, "1"], ["-1", "-2"])
    for name in ("-1", "-2"):
        Image.new("RGBA", (8, 6), (0, int(name[1]), 0, 255)).save(tmp_path / f"artifact{name}.png")
    page = report_page(tmp_path, "drive", STAGES, {})
    assert shown(page, tmp_path / "artifact-2.png") == 1
    assert shown(page, tmp_path / "artifact-1.png") == 3


def test_of_faces_it_is_shown_once_above_all(tmp_path):
    page = page_of(tmp_path, ["a", None, "b"], [""], on_sphere=True)
    assert shown(page, tmp_path / "artifact.png") == 0
    assert "The artifact in all directions" in page


def test_learned_exposures_are_a_file_and_a_figure(tmp_path):
    page = page_of(tmp_path, ["a"], [""])
    assert "exposure.json" not in page
    assert "23.25" not in page
    (tmp_path / "exposure.json").touch()
    page = report_page(tmp_path, "drive", STAGES, {})
    assert 'href="exposure.json"' in page
    assert "23.25 dB" in page


def test_of_faces_whose_artifact_changes_every_overlay_is_shown(tmp_path):
    page = page_of(tmp_path, ["1", "2"], ["-1", "-2"], on_sphere=True)
    assert page.count("The artifact, over a checkerboard") == 2
    assert "in all directions" not in page


@pytest.mark.parametrize("clean", [True, False])
def test_the_composite_is_compared_with_photos_that_carry_the_artifact_alone(tmp_path, clean):
    page_of(tmp_path, ["a"], [""])
    evaluation = Evaluation.read(tmp_path / "evaluation")
    metrics = {**evaluation.metrics, "composite_psnr": 14.77}
    replace(evaluation, metrics=metrics, clean_test_views=clean).write(tmp_path / "evaluation")
    page = report_page(tmp_path, "drive", STAGES, {})
    assert ("14.77 dB" in page) != clean
    assert ("They carry the artifact" in page) != clean
    assert ("higher is better" in page[page.index("<td>PSNR</td>") :]) == clean


@pytest.mark.parametrize("detected", [True, False])
def test_photos_with_an_artifact_that_was_not_learned_do_not_judge_the_splats(tmp_path, detected):
    page_of(tmp_path, [None], [])
    evaluation = replace(Evaluation.read(tmp_path / "evaluation"), clean_test_views=False, detected=detected)
    evaluation.write(tmp_path / "evaluation")
    page = report_page(tmp_path, "drive", STAGES, {})
    assert ("splats that show the artifact get better figures" in page) == detected
    assert ("higher is better" in page) != detected
