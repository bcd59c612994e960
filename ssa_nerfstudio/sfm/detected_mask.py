"""What detection says of a camera's photos: when there is an artifact, where it is opaque, and of the user's mask."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from ssa_nerfstudio.evidence.statistics import ImageStatistics

_SIZE = 960
"""Longest side to which photos are reduced for detection, pixels: twice its working resolution."""

_WHOLE_FRAME = 0.999
"""Share of the frame from which on a mask is of all of it, but for pixels at its border."""


@dataclass(frozen=True)
class FoundArtifact:
    """What a detection found in the photos of one camera, as far as structure from motion makes use of it."""

    verdict: Literal["none", "faint", "opaque"]
    """As of `evidence.detection.Detection`."""
    mask: np.ndarray
    """bool [H, W] of the upright photos, or smaller: True where the artifact is."""
    stretches: tuple[slice, ...]
    """Of photos in the order of the capture, those with an artifact that does not change in them."""
    photos: int
    """How many were tested."""

    @classmethod
    def of(
        cls,
        verdict: Literal["none", "faint", "opaque"],
        mask: np.ndarray,
        photos: int,
        intervals: Sequence[tuple[int, int, str]] = (),
    ) -> FoundArtifact:
        """From what detection says of the photos, and of each interval: its first photo, the one after, its verdict."""
        stretches = [(first, end) for first, end, own in intervals or [(0, photos, verdict)] if own != "none"]
        return cls(verdict, mask, tuple(slice(*each) for each in stretches), photos)


class CameraEvidence:
    """What detection finds in the photos of one camera.

    They are read when something is first asked; once for all questions, and again where the artifact changes.
    """

    def __init__(
        self, photos: Sequence[Path], advance: Callable[[int], None], found: FoundArtifact | None = None
    ) -> None:
        """Store the arguments.

        Args:
            photos: files of one size, at least one, in the order of the capture.
            advance: called with the number of photos read so far.
            found: in these photos by an earlier detection, which is then not repeated; what it found in another number
                of photos, such as other frames of a video, is not used.
        """
        self._files, self._advance = photos, advance
        self._given = found if found is not None and found.photos == len(photos) else None

    def opaque_mask(self) -> np.ndarray | None:
        """Mask an opaque artifact.

        Semi-transparent artifacts are not masked: a mask of mud or rain would hide the scene behind it, too.

        Returns:
            bool [H, W] of the photos' size, True where features may lie; None where no opaque artifact is found.

        Raises:
            InputError: a photo cannot be decoded.
        """
        if self._found.verdict != "opaque":
            return None
        height, width = read_photo(self._files[0]).shape[:2]
        used = (~self._found.mask).astype(np.uint8)
        return cv2.resize(used, (width, height), interpolation=cv2.INTER_NEAREST) > 0

    def stands_still(self) -> bool:
        """Whether nothing moves anywhere in the frame, of which an artifact leaves a part; False if it is not known.

        Photos that cannot be tested, such as transparent ones, tell nothing.
        """
        try:
            return float(self._found.mask.mean()) >= _WHOLE_FRAME
        except InputError:
            return False

    def unchanged_stretches(self) -> list[slice]:
        """Stretches of photos with an artifact, opaque or not, that does not change in them; empty where there is none.

        Photos that cannot be tested, such as transparent ones, may all show one.
        """
        try:
            return [*self._found.stretches]
        except InputError:
            return [slice(0, len(self._files))]

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
    def _found(self) -> FoundArtifact:
        if self._given is not None:
            return self._given
        from ssa_nerfstudio.evidence.interval_detection import detect_in_intervals

        detection = detect_in_intervals(self._photos, whole=self._statistics)
        intervals = [(each.first, each.end, each.verdict) for each in detection.intervals]
        return FoundArtifact.of(detection.verdict, detection.mask.numpy(), len(self._files), intervals)

    @cached_property
    def _statistics(self) -> ImageStatistics:
        from ssa_nerfstudio.evidence.statistics import accumulate

        return accumulate((photo, None) for photo in self._photos())

    def _photos(self) -> Iterator[Tensor]:
        """The photos, reduced."""
        import torch

        for number, path in enumerate(self._files, 1):
            photo = read_photo(path)
            height, width = photo.shape[:2]
            if (scale := _SIZE / max(width, height)) < 1:
                reduced = max(1, round(width * scale)), max(1, round(height * scale))
                photo = cv2.resize(photo, reduced, interpolation=cv2.INTER_AREA)
            yield torch.from_numpy(photo)
            self._advance(number)
