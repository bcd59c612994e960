"""What detection says of the photos of a camera, for which they are read once."""

from __future__ import annotations

import numpy as np
import pytest
from small_captures import HEIGHT, WIDTH, write

from ssa_nerfstudio.sfm.detected_mask import CameraEvidence, FoundArtifact

VIEWS = 24


@pytest.mark.parametrize(("effect", "stretches"), [("mud", [slice(0, VIEWS)]), (None, [])])
def test_photos_are_read_once_for_all_questions(effect, stretches, tmp_path, draw_effect, photos):
    shown = photos(VIEWS)
    if effect is not None:
        shown = [draw_effect(effect, HEIGHT, WIDTH).apply(photo) for photo in shown]
    folder = write(tmp_path / "photos", shown)
    read: list[int] = []
    evidence = CameraEvidence([folder / f"photo_{number}.png" for number in range(VIEWS)], read.append)
    assert read == []
    assert evidence.unchanged_stretches() == stretches
    assert evidence.opaque_mask() is None
    evidence.check_mask_polarity(np.ones((HEIGHT, WIDTH), dtype=bool))
    assert read == [*range(1, VIEWS + 1)]


def test_photos_that_cannot_be_tested_may_show_an_artifact(tmp_path, photos):
    transparent = [np.dstack([photo, np.full(photo.shape[:2], 128, np.uint8)]) for photo in photos(VIEWS)[:8]]
    folder = write(tmp_path / "photos", transparent)
    evidence = CameraEvidence(sorted(folder.iterdir()), lambda _: None)
    assert evidence.unchanged_stretches() == [slice(0, 8)]


def test_what_an_earlier_detection_found_is_taken_without_reading_all_photos(tmp_path, photos):
    files = sorted(write(tmp_path / "photos", photos(8)).iterdir())
    hidden = np.zeros((HEIGHT, WIDTH), dtype=bool)
    hidden[:30] = True
    found = FoundArtifact.of("opaque", hidden, 8, [(0, 3, "none"), (3, 8, "opaque")])
    read: list[int] = []
    evidence = CameraEvidence(files, read.append, found)
    assert evidence.unchanged_stretches() == [slice(3, 8)]
    used = evidence.opaque_mask()
    assert used is not None
    assert np.array_equal(used, ~hidden)
    assert read == []


def test_what_was_found_in_other_photos_is_not_used(tmp_path, photos):
    """Frames of a video, of which structure from motion takes another number."""
    files = sorted(write(tmp_path / "photos", photos(8)).iterdir())
    found = FoundArtifact.of("opaque", np.ones((HEIGHT, WIDTH), dtype=bool), 20)
    evidence = CameraEvidence(files, lambda _: None, found)
    assert evidence.opaque_mask() is None
