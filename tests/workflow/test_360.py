"""`ssa run` on a 360 clip: one command, a report, and the operator as one artifact on the sphere."""

from __future__ import annotations

import io
import json
import re
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from gsply import plyread
from PIL import Image
from wide_captures import operator, panorama, panorama_poses, with_operator, write_clip

from ssa_nerfstudio.cli import main

pytestmark = pytest.mark.slow

VIEWS, WIDTH = 8, 512


@pytest.fixture(scope="module")
def finished(tmp_path_factory, trace_built_in_scene) -> tuple[Path, str]:
    """The folder of a run and what it printed."""
    folder = tmp_path_factory.mktemp("capture")
    photos = [panorama(trace_built_in_scene, pose, WIDTH) for pose in panorama_poses(VIEWS)]
    clip = write_clip(folder / "walk.mp4", [with_operator(photo) for photo in photos])
    printed = io.StringIO()
    with redirect_stdout(printed):
        main([
            "run", str(clip), "--output", str(folder / "out"), "--steps", "20", "--process.threads", "1",
            "--process.leave-out", "up",
        ])  # fmt: skip
    return folder / "out", printed.getvalue()


def test_it_says_in_one_line_what_it_takes_the_clip_for(finished):
    (line,) = [line for line in finished[1].splitlines() if "equirectangular" in line]
    assert re.search(r"walk\.mp4 is taken for equirectangular \(512 x 256\): cut into perspective faces", line)
    assert "(front, right, back, left, down)" in line
    assert "(--process.projection perspective takes" in line


def test_all_stages_did_what_they_should(finished):
    record = json.loads((finished[0] / "run.json").read_text())
    results = {name: stage["done"]["text"] for name, stage in record.items()}
    assert results["detect"].startswith("a static artifact"), "in the whole frame, as one camera"
    assert results["process"].startswith(f"{5 * VIEWS} of {5 * VIEWS} photos have poses")
    assert "the artifact in 2 faces of the panoramas was learned" in results["train"], "those that see the operator"
    assert "with the artifact that they have" in results["evaluate"]
    assert len(plyread(str(finished[0] / "splats.ply")).means) > 100


def test_the_artifact_is_the_operator_on_the_sphere(finished):
    artifact, matte = (np.asarray(Image.open(finished[0] / f"{name}.png")) for name in ("artifact", "matte"))
    assert artifact.shape == (WIDTH // 2, WIDTH, 4)
    assert np.array_equal(artifact[..., 3], matte)
    true = operator(WIDTH)[..., 0] > 0
    assert matte[true].mean() > 0.8 * 255
    assert matte[~true].mean() < 0.1 * 255


def test_the_page_shows_it_once(finished):
    page = (finished[0] / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert page.count("data:image/jpeg;base64,") == 2 * 5
    assert "The artifact in all directions" in page
    assert 'href="artifact.png"' in page
    assert "--equirectangular" in page
    assert "--leave-out up" in page


def test_it_is_what_export_overlay_writes(finished, tmp_path):
    config = finished[0] / "training/ssa-splatfacto/config.yml"
    main(["export-overlay", "--load-config", str(config), "--output", str(tmp_path / "artifact"), "--equirectangular"])
    ours, theirs = (
        np.asarray(Image.open(folder)) for folder in (finished[0] / "artifact.png", tmp_path / "artifact/overlay.png")
    )
    visible = ours[..., 3] > 0
    assert np.abs(ours[visible].astype(int) - theirs[visible]).max() <= 1
