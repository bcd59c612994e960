"""What detection says of the photos of a camera, for which they are read once."""

from __future__ import annotations

import numpy as np
import pytest
from small_captures import HEIGHT, WIDTH, write

from ssa_nerfstudio.sfm.detected_mask import CameraEvidence

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
