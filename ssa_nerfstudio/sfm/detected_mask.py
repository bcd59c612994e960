"""A mask of the opaque artifact that detection finds in the photos of a pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from ssa_nerfstudio.data.photos import read_photo

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
    import torch

    from ssa_nerfstudio.evidence.detection import detect
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
    found = detect(statistics)
    if found.verdict != "opaque":
        return None
    return cv2.resize((~found.mask).numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
