"""Structure from motion with masks of what an earlier detection found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_captures import HEIGHT, WIDTH, write

from ssa_nerfstudio.data.sources import read_sources
from ssa_nerfstudio.sfm.detected_mask import FoundArtifact
from ssa_nerfstudio.sfm.photos_to_dataset import Summary, process
from ssa_nerfstudio.sfm.reconstruction import SfmSettings

VIEWS = 10


@pytest.fixture(scope="module")
def capture(tmp_path_factory, photos) -> Path:
    return write(tmp_path_factory.mktemp("capture") / "photos", photos(VIEWS))


def processed(capture: Path, output: Path, hidden: np.ndarray) -> tuple[Summary, set[str]]:
    """What came of an opaque artifact where `hidden` is True, and the parts that progress was shown of."""
    shown: dict[str, list[float]] = {}

    def show(part: str, done: int, total: int) -> None:
        shown.setdefault(part, []).append(done / total)

    found = FoundArtifact.of("opaque", hidden, VIEWS)
    sources = read_sources(capture, "frame", min_photos=3)
    settings = SfmSettings(threads=1)
    summary = process(
        *(sources, output),
        detect=True,
        settings=settings,
        found=[found],
        on_progress=show,
    )
    assert shown.keys() <= {"photos", "detection", "artifact", "features", "matches", "poses", "other lenses"}
    assert all(min(shares) >= 0 and max(shares) == shares[-1] == 1 for shares in shown.values())
    return summary, {*shown}


def test_what_is_known_is_masked_and_not_detected_again(capture, tmp_path):
    hidden = np.zeros((HEIGHT // 2, WIDTH // 2), dtype=bool)
    hidden[-20:] = True
    summary, parts = processed(capture, tmp_path / "out", hidden)
    assert summary.passes[0].count == VIEWS
    assert not summary.unmasked
    assert "detection" not in parts
    used = np.asarray(Image.open(tmp_path / "out/mask_colmap.png"))
    assert used.shape == (HEIGHT, WIDTH)
    assert not used[-40:].any()
    assert used[:-44].all()
    assert summary.masked == pytest.approx(1 - used.mean())
    assert Summary.read(tmp_path / "out") == summary


def test_masks_that_hide_too_much_are_left_out(capture, tmp_path):
    hidden = np.ones((HEIGHT, WIDTH), dtype=bool)
    hidden[:12, :12] = False
    summary, _ = processed(capture, tmp_path / "out", hidden)
    assert summary.unmasked
    assert summary.masked == 0
    assert summary.passes[0].count == VIEWS
    assert not (tmp_path / "out/mask_colmap.png").exists()
