"""What detection says about masks: of the opaque artifact that it finds in the photos of a pass, and of the user's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    from ssa_nerfstudio.evidence.statistics import ImageStatistics

_SIZE = 960
"""Longest side to which photos are reduced for detection, pixels: twice its working resolution."""


def detected_mask(photos: Sequence[Path], advance: Callable[[int], None]) -> np.ndarray | None:
    """Detect an opaque artifact and mask it.

    Semi-transparent artifacts are not masked: a mask of mud or rain would hide the scene behind it, too.

    Args:
        photos: files of one size, in the order of the capture.
        advance: called with the number of photos read so far.

    Returns:
        bool [H, W] of the photos' size, True where features may lie; None where no opaque artifact is found.
    """
    from ssa_nerfstudio.evidence.detection import detect

    statistics, size = _statistics(photos, advance)
    found = detect(statistics)
    if found.verdict != "opaque":
        return None
    return cv2.resize((~found.mask).numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def has_artifact(photos: Sequence[Path]) -> bool:
    """Whether photos of one size, in the order of the capture, show a static artifact, opaque or not.

    Photos that cannot be tested, such as transparent ones, may show one.
    """
    from ssa_nerfstudio.evidence.detection import detect

    try:
        statistics, _ = _statistics(photos, lambda _: None)
    except InputError:
        return True
    return detect(statistics).verdict != "none"


def check_mask_polarity(mask: np.ndarray, photos: Sequence[Path], advance: Callable[[int], None]) -> None:
    """Check that a mask does not keep the artifact that is detected, instead of leaving it out.

    Args:
        mask: bool [H, W], True where features may lie.
        photos, advance: as for `detected_mask`.

    Raises:
        InputError: it certainly does; where that is only likely, a warning is logged.
    """
    from ssa_nerfstudio.evidence.mask_polarity import check_polarity

    statistics, _ = _statistics(photos, advance)
    height, width = statistics.size
    reduced = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    check_polarity(reduced, statistics, "--mask", "invert it with --invert-mask: black is ignored")


def _statistics(photos: Sequence[Path], advance: Callable[[int], None]) -> tuple[ImageStatistics, tuple[int, int]]:
    """Statistics of reduced photos, and the width and height of the photos themselves."""
    import torch

    from ssa_nerfstudio.evidence.statistics import ImageStatistics

    statistics = ImageStatistics()
    size = 0, 0
    for number, path in enumerate(photos, 1):
        photo = read_photo(path)
        size = photo.shape[1], photo.shape[0]
        if (scale := _SIZE / max(size)) < 1:
            reduced = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
            photo = cv2.resize(photo, reduced, interpolation=cv2.INTER_AREA)
        statistics.add(torch.from_numpy(photo))
        advance(number)
    return statistics, size
