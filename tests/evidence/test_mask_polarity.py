"""Masks of both polarities, of the artifact and of other things, over photos behind known artifacts."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from small_captures import HEIGHT, WIDTH

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.detection import detect
from ssa_nerfstudio.evidence.mask_polarity import check_polarity, polarity
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate

ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
PERSON = (COLUMNS / WIDTH - 0.7) ** 2 * 4 + (ROWS / HEIGHT - 0.2) ** 2 < 0.03
"""Something that masks leave out, too."""


@pytest.fixture(scope="module")
def behind(draw_effect, photos):
    """Statistics of photos behind an artifact, and where it is, bool [H, W]."""

    def behind(artifact: str) -> tuple[ImageStatistics, np.ndarray]:
        if artifact == "dashboard of 60 %":
            there = (ROWS > 0.48 * HEIGHT) | (COLUMNS < 0.16 * WIDTH)
            texture = np.random.default_rng(0).integers(30, 90, (HEIGHT // 4, WIDTH // 4)).repeat(4, 0).repeat(4, 1)
            pictures = [np.where(there[..., None], texture[..., None], photo).astype(np.uint8) for photo in photos(24)]
        else:
            layers = draw_effect(artifact, HEIGHT, WIDTH)
            there, pictures = layers.transmittance.min(axis=-1) <= 0.9, [layers.apply(photo) for photo in photos(24)]
        return accumulate((torch.from_numpy(picture), None) for picture in pictures), there

    return behind


@pytest.mark.parametrize("artifact", ["dashboard", "dashboard of 60 %", "ui"])
def test_only_a_mask_that_keeps_the_artifact_alone_is_refused(artifact, behind, caplog):
    statistics, there = behind(artifact)
    with caplog.at_level(logging.WARNING):
        for good in (~there, ~PERSON, ~there & ~PERSON, ROWS > 0.3 * HEIGHT, np.ones_like(there)):
            check_polarity(good, statistics, "the mask", "invert it")
    assert not caplog.records
    with pytest.raises(InputError, match=r"the mask keeps \d+% of the frame, which is the static artifact.*invert it"):
        check_polarity(there, statistics, "the mask", "invert it")


def test_a_mask_that_keeps_what_shows_through_is_doubted(behind, caplog):
    statistics, there = behind("watermark")
    found = detect(statistics).mask.numpy()
    assert polarity(found, statistics, detect(statistics)) == "doubtful"
    with caplog.at_level(logging.WARNING):
        check_polarity(found, statistics, "the mask", "invert it")
        check_polarity(~found, statistics, "the mask", "invert it")
        check_polarity(~there, statistics, "the mask", "invert it")
    assert len(caplog.records) == 1


def test_without_an_artifact_no_mask_is_doubted(photos):
    statistics = accumulate((torch.from_numpy(photo), None) for photo in photos(24))
    for used in (PERSON, ~PERSON, ROWS < 0.3 * HEIGHT, ROWS >= 0.3 * HEIGHT):
        assert polarity(used, statistics, detect(statistics)) == "plausible"
