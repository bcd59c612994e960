"""What a detection says, and the files that show it."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from ssa_nerfstudio.evidence.capture_detection import detections_to_json, write_detections
from ssa_nerfstudio.evidence.detection import Detection, Interval
from ssa_nerfstudio.evidence.verdict_in_words import verdict_in_words

MASK = torch.zeros(4, 6, dtype=torch.bool)
MASK[2:, 1:3] = True
NOWHERE = torch.zeros(4, 6, dtype=torch.bool)
EVIDENCE = torch.tensor([[0.0, 3.0, 6.0], [12.0, 24.0, 1.0]])
FOUND = Detection("opaque", 0.1234, 0.005, (0.0, 0.0184), 25, (0.02, 0.05), (0.001, 0.002), EVIDENCE, MASK, MASK)
NONE = replace(FOUND, verdict="none", coverage=0.0, p_value=0.3, p_interval=(0.2, 0.4), mask=NOWHERE, opaque=NOWHERE)
PARTS = (Interval(0, 10, "none", 0.0), Interval(10, 25, "faint", 0.031))


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (
            replace(NONE, views=5, p_value=1.0),
            "too few photos (5) to tell whether they have a static artifact; 6 are needed",
        ),
        (replace(NONE, views=6), "no static artifact in 6 photos"),
        (NONE, "no static artifact in 25 photos"),
        (replace(NONE, p_value=0.01), "no static artifact in 25 photos: some edges stand still, but too few to be one"),
        (
            FOUND,
            "a static artifact over 12.3% of the frame, opaque, at least in part, in 25 photos "
            "(chance of a false alarm at most 1.8%)",
        ),
        (
            replace(FOUND, verdict="faint"),
            "a static artifact over 12.3% of the frame, semi-transparent, in 25 photos "
            "(chance of a false alarm at most 1.8%)",
        ),
        (
            replace(FOUND, coverage=1.0, mask=torch.ones(4, 6, dtype=torch.bool)),
            "nothing moves in 25 photos: are they of one view? Those of a scene are taken from many",
        ),
        (
            replace(FOUND, intervals=PARTS),
            "an artifact that changes: in photos 1 to 10 none, in photos 11 to 25 3.1% of the frame, semi-transparent",
        ),
    ],
)
def test_a_verdict_is_one_sentence(found, said):
    assert verdict_in_words(found) == said


def test_a_report_has_what_was_found_of_every_camera():
    groups = json.loads(detections_to_json({"front": FOUND, "back": replace(NONE, intervals=PARTS)}))["groups"]
    assert groups[0] == {
        "name": "front", "verdict": "opaque", "coverage": 0.1234, "p_value": 0.005, "p_interval": [0.0, 0.0184],
        "views": 25, "shares": [0.02, 0.05], "null_shares": [0.001, 0.002], "width": 6, "height": 4, "intervals": [],
    }  # fmt: skip
    assert (groups[1]["name"], groups[1]["verdict"]) == ("back", "none")
    assert groups[1]["intervals"][1] == {"first": 10, "end": 25, "verdict": "faint", "coverage": 0.031}


@pytest.mark.parametrize("cameras", [("only",), ("front", "back")])
def test_masks_are_black_where_the_artifact_is_and_several_cameras_have_folders(tmp_path, cameras):
    write_detections(tmp_path, dict.fromkeys(cameras, FOUND))
    folders = [tmp_path / name for name in cameras] if len(cameras) > 1 else [tmp_path]
    names = ["evidence.png", "mask_colmap.png", "mask_nerfstudio.png"]
    for folder in folders:
        assert sorted(path.name for path in folder.iterdir()) == names
        for name in names[1:]:
            written = np.asarray(Image.open(folder / name))
            assert written.dtype == np.uint8
            assert (written == np.where(MASK.numpy(), 0, 255)).all()
    assert len([*tmp_path.iterdir()]) == (3 if len(cameras) == 1 else 2)


def test_evidence_is_drawn_from_black_to_the_brightest_at_twice_the_threshold(tmp_path):
    write_detections(tmp_path, {"only": FOUND})
    drawn = np.asarray(Image.open(tmp_path / "evidence.png")).astype(int)
    levels = np.array([[0, 63, 127], [255, 255, 21]], np.uint8)  # of 12: 3, 6, 12, 24 and 1
    expected = cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1]
    assert np.abs(drawn - expected).max() <= 2
    assert drawn[1, 0, 0] > drawn[1, 0, 2], "the brightest is yellow, not blue"
