"""The mask of an opaque artifact that detection finds in the photos of a pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

_SIZE = 960
"""Longest side of the photos that detection looks at, pixels: twice its working resolution."""


def detected_mask(photos: Sequence[Path], on_photo: Callable[[int], None]) -> np.ndarray | None:
    """Where no opaque artifact is.

    What light shines through is not masked: behind mud or rain that would hide the scene, too.

    Args:
        photos: files of one size, in the order of the capture.
        on_photo: called with how many have been read.

    Returns:
        bool [H, W] of the photos' size, True where features may lie; None where there is no opaque artifact.
    """
    import torch

    from ssa_nerfstudio.evidence.detection import detect
    from ssa_nerfstudio.evidence.statistics import ImageStatistics

    statistics = ImageStatistics()
    size = 0, 0
    for number, path in enumerate(photos, 1):
        photo = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        size = photo.shape[1], photo.shape[0]
        if (scale := _SIZE / max(size)) < 1:
            reduced = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
            photo = cv2.resize(photo, reduced, interpolation=cv2.INTER_AREA)
        statistics.add(torch.from_numpy(cv2.cvtColor(photo, cv2.COLOR_BGR2RGB)))
        on_photo(number)
    found = detect(statistics)
    if found.verdict != "opaque":
        return None
    return cv2.resize((~found.mask).numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
