"""What detection says of a camera's photos: when there is an artifact, where it is opaque, and of the user's mask."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from ssa_nerfstudio.evidence.detection import Detection
    from ssa_nerfstudio.evidence.statistics import ImageStatistics

_SIZE = 960
"""Longest side to which photos are reduced for detection, pixels: twice its working resolution."""


class CameraEvidence:
    """What detection finds in the photos of one camera.

    They are read when something is first asked; once for all questions, and again where the artifact changes.
    """

    def __init__(self, photos: Sequence[Path], advance: Callable[[int], None]) -> None:
        """Store the arguments.

        Args:
            photos: files of one size, at least one, in the order of the capture.
            advance: called with the number of photos read so far.
        """
        self._files, self._advance = photos, advance
        self._size = 0, 0

    def opaque_mask(self) -> np.ndarray | None:
        """Mask an opaque artifact.

        Semi-transparent artifacts are not masked: a mask of mud or rain would hide the scene behind it, too.

        Returns:
            bool [H, W] of the photos' size, True where features may lie; None where no opaque artifact is found.

        Raises:
            InputError: a photo cannot be decoded.
        """
        if self._detection.verdict != "opaque":
            return None
        used = (~self._detection.mask).numpy().astype(np.uint8)
        return cv2.resize(used, self._size, interpolation=cv2.INTER_NEAREST) > 0

    def unchanged_stretches(self) -> list[slice]:
        """Stretches of photos with an artifact, opaque or not, that does not change in them; empty where there is none.

        Photos that cannot be tested, such as transparent ones, may all show one.
        """
        everything = slice(0, len(self._files))
        try:
            found = self._detection
        except InputError:
            return [everything]
        if not found.intervals:
            return [] if found.verdict == "none" else [everything]
        return [slice(each.first, each.end) for each in found.intervals if each.verdict != "none"]

    def check_mask_polarity(self, mask: np.ndarray) -> None:
        """Check that a mask does not keep the artifact that is detected, instead of leaving it out.

        Args:
            mask: bool [H, W], True where features may lie.

        Raises:
            InputError: it certainly does; where that is only likely, a warning is logged. A photo cannot be decoded.
        """
        from ssa_nerfstudio.evidence.mask_polarity import check_polarity

        height, width = self._statistics.size
        reduced = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
        check_polarity(reduced, self._statistics, "--mask", "invert it with --invert-mask: black is ignored")

    @cached_property
    def _detection(self) -> Detection:
        from ssa_nerfstudio.evidence.interval_detection import detect_in_intervals

        return detect_in_intervals(self._photos, whole=self._statistics)

    @cached_property
    def _statistics(self) -> ImageStatistics:
        from ssa_nerfstudio.evidence.statistics import accumulate

        return accumulate((photo, None) for photo in self._photos())

    def _photos(self) -> Iterator[Tensor]:
        """The photos, reduced."""
        import torch

        for number, path in enumerate(self._files, 1):
            photo = read_photo(path)
            self._size = photo.shape[1], photo.shape[0]
            if (scale := _SIZE / max(self._size)) < 1:
                reduced = max(1, round(self._size[0] * scale)), max(1, round(self._size[1] * scale))
                photo = cv2.resize(photo, reduced, interpolation=cv2.INTER_AREA)
            yield torch.from_numpy(photo)
            self._advance(number)
