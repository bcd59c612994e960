"""Warnings of a run whose training has not learned what detection found."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers
from ssa_nerfstudio.workflow.detection_folder import VERDICTS
from ssa_nerfstudio.workflow.photos_to_splats import DETECTION, missed_artifacts


def layers(name: str, covered: int) -> ArtifactLayers:
    """Layers that hide so many of 20 rows."""
    transmittance = np.ones((20, 30, 3), np.float32)
    transmittance[:covered] = 0
    lens = Lens(30, 20, 30, 30, 15, 10)
    return ArtifactLayers(transmittance, np.zeros_like(transmittance), lens, "undistorted", "learned", name)


def warnings(folder: Path, verdicts: dict[str, str], learned: list[ArtifactLayers], overlay: str = "auto") -> list[str]:
    (folder / DETECTION).mkdir()
    groups = [{"name": name, "verdict": verdict} for name, verdict in verdicts.items()]
    (folder / DETECTION / VERDICTS).write_text(json.dumps({"groups": groups}))
    model = SimpleNamespace(overlay=overlay)
    plan = SimpleNamespace(output=folder, training=SimpleNamespace(pipeline=SimpleNamespace(model=model)))
    return missed_artifacts(plan, learned)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("verdicts", "learned", "overlay"),
    [
        ({"front": "opaque", "side": "none"}, [layers("front", 5)], "auto"),
        ({"front": "none"}, [], "auto"),
        ({"front": "none"}, [layers("camera_0", 5)], "auto"),
        ({"frame": "opaque"}, [layers("frame_down", 9), layers("frame_right", 2)], "auto"),
        ({"front": "faint"}, [], "off"),
    ],
)
def test_there_is_none_where_all_was_learned_or_nothing_was_wanted(tmp_path, verdicts, learned, overlay):
    assert warnings(tmp_path, verdicts, learned, overlay) == []


def test_an_artifact_that_training_did_not_see_is_named_with_the_remedy(tmp_path):
    (warning,) = warnings(tmp_path, {"camera_0": "faint", "camera_1": "opaque"}, [layers("camera_0", 5)])
    assert "in the photos of camera_0, camera_1, the training in those of camera_0;" in warning
    assert "--train.pipeline.model.overlay on" in warning


def test_an_overlay_that_stayed_clear_is_named(tmp_path):
    (warning,) = warnings(tmp_path, {"frame": "opaque"}, [layers("frame_down", 9), layers("frame_right", 0)])
    assert "the overlay of frame_right is nearly clear" in warning
