"""Warnings of a run whose training has not learned what detection found."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.workflow.detection_folder import VERDICTS
from ssa_nerfstudio.workflow.learned_artifacts import clear_overlays, learned_in_words, learned_shares
from ssa_nerfstudio.workflow.photos_to_splats import DETECTION, warn_of_missed_artifacts


def layers(name: str, covered: int) -> ArtifactLayers:
    """Layers that hide so many of 20 rows."""
    transmittance = np.ones((20, 30, 3), np.float32)
    transmittance[:covered] = 0
    lens = Lens(30, 20, 30, 30, 15, 10)
    return ArtifactLayers(transmittance, np.zeros_like(transmittance), lens, "undistorted", "learned", name)


def overlays_of(covered: list[str], bare: list[str]) -> Artifacts:
    """Overlays of these cameras, one for each time that a camera is named, and others without any."""
    cameras = covered + bare
    keys = torch.tensor([[4, 3, number, number, 2, 1.5] for number in map(cameras.index, cameras)], dtype=torch.float64)
    starts = [f"images/{number}.png" for number in range(len(cameras))]
    made = Artifacts()
    overlays = [ScreenSpaceOverlay(3, 4) for _ in covered] + [None] * len(bare)
    made.assign(overlays, keys.reshape(-1, 6), [], torch.zeros(len(cameras), 16), starts, cameras)
    return made


def warn(
    folder: Path, caplog, verdicts: dict[str, str], covered: list[str], overlay: str = "auto", bare: Sequence[str] = ()
) -> list[str]:
    """What is warned of where detection found this, and the training has overlays of these cameras."""
    (folder / DETECTION).mkdir()
    groups = [{"name": name, "verdict": verdict} for name, verdict in verdicts.items()]
    (folder / DETECTION / VERDICTS).write_text(json.dumps({"groups": groups}))
    model = SimpleNamespace(overlay=overlay)
    plan = SimpleNamespace(output=folder, training=SimpleNamespace(pipeline=SimpleNamespace(model=model)))
    warn_of_missed_artifacts(plan, overlays_of(covered, [*bare]))  # type: ignore[arg-type]
    return caplog.messages


@pytest.mark.parametrize(
    ("verdicts", "overlays", "overlay"),
    [
        ({"front": "opaque", "side": "none"}, ["front"], "auto"),
        ({"front": "none"}, [], "auto"),
        ({"front": "none"}, ["camera_0"], "auto"),
        ({"frame": "opaque"}, ["frame_down", "frame_right"], "auto"),
        ({"front": "faint"}, [], "off"),
        ({"front": "opaque"}, ["front", "front"], "auto"),
    ],
)
def test_there_is_none_where_all_was_learned_or_nothing_was_wanted(tmp_path, caplog, verdicts, overlays, overlay):
    assert warn(tmp_path, caplog, verdicts, overlays, overlay) == []


@pytest.mark.parametrize(
    ("verdicts", "overlays", "said"),
    [
        ({"left": "faint", "right": "opaque"}, ["left"], "the photos of left, right, the training in those of left;"),
        ({"left": "faint", "right": "none"}, [], "the photos of left, the training in none;"),
        ({"camera_0": "faint"}, [], "the photos, the training in none;"),
        ({"front": "faint", "side": "faint"}, ["front", "front"], "front, side, the training in those of front;"),
    ],
)
def test_an_artifact_that_training_did_not_see_is_named_with_the_remedy(tmp_path, caplog, verdicts, overlays, said):
    bare = [name for name in verdicts if name not in overlays]
    (warning,) = warn(tmp_path, caplog, verdicts, overlays, bare=bare)
    assert said in warning
    assert "--train.pipeline.model.overlay on" in warning


def test_an_overlay_that_stayed_clear_is_named():
    (warning,) = clear_overlays([layers("frame_down", 9), layers("frame_right", 0)])
    assert "the overlay of frame_right is nearly clear" in warning
    assert clear_overlays([layers("frame_down", 9), layers("frame_right", 2)]) == []
    assert clear_overlays([]) == []


@pytest.mark.parametrize(("hidden", "clear"), [(0, True), (1, True), (3, False)])
def test_what_hides_less_than_a_thousandth_of_the_frame_is_nearly_clear(hidden, clear):
    transmittance = np.ones((30, 40, 3), np.float32)  # a pixel is 0.083 % of it
    transmittance.reshape(-1, 3)[:hidden] = 0
    dot = replace(layers("dot", 0), transmittance=transmittance, addition=np.zeros_like(transmittance))
    assert bool(clear_overlays([dot])) == clear


def test_what_was_learned_is_called_by_what_the_overlays_are_of():
    front, side = layers("front", 9), layers("side", 1)
    assert learned_in_words([], False) == "the scene alone was learned"
    assert learned_in_words([front], True) == "the artifact was learned with the scene"
    assert learned_in_words([front, side], False) == "the artifacts of 2 cameras were learned with the scene"
    assert learned_in_words([front, side], True).startswith("the artifact in 2 faces of the panoramas was learned")
    later = replace(front, start="img_9.jpg")
    assert learned_in_words([front, later], True) == "the artifacts of 2 intervals were learned with the scene"


def test_what_was_learned_is_said_with_its_share_of_the_frame():
    assert learned_shares([layers("camera_0", 9)]) == ", over 45.0% of the frame"
    assert learned_shares([layers("front", 9), layers("side", 1)]) == ", over 45.0% of front, 5.0% of side"
    assert learned_shares([]) == ""
