"""Frames of videos: evenly spaced, and the sharpest of their neighborhood."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ssa_nerfstudio.errors import InputError

_WINDOW = 0.5
"""Searched share of each part of the video; distances of chosen frames vary from 0.5 to 1.5 parts."""
_SHARPNESS_WIDTH = 480


@dataclass(frozen=True)
class Video:
    """A video file."""

    path: Path
    width: int
    """Of the upright frame, pixels."""
    height: int
    """Of the upright frame, pixels."""
    frames: int
    """Number of frames as the header states it, at least 1."""

    @classmethod
    def read(cls, path: Path) -> Video:
        """Open a video and decode its first frame.

        Raises:
            InputError: it cannot be decoded.
        """
        capture = cv2.VideoCapture(str(path))
        decoded, frame = capture.read()
        frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if decoded and frames < 1:
            frames = 1
            while capture.grab():
                frames += 1
        capture.release()
        if not decoded:
            raise InputError(f"{path} is no video that can be decoded", "convert it to H.264 in .mp4")
        return cls(path, frame.shape[1], frame.shape[0], frames)

    def spread(self, count: int) -> Iterator[np.ndarray]:
        """Seek and decode evenly spaced frames, without looking at the others; fewer where seeking fails.

        Yields:
            BGR uint8 [height, width, 3], upright.
        """
        capture = cv2.VideoCapture(str(self.path))
        for part in range(count):
            capture.set(cv2.CAP_PROP_POS_FRAMES, (self.frames * part) // count)
            decoded, frame = capture.read()
            if decoded:
                yield frame
        capture.release()

    def sharpest(self, count: int) -> Iterator[tuple[int, np.ndarray]]:
        """Choose the sharpest frame in the middle half of each of `count` equal parts of the video.

        Decodes the video once and keeps one frame in memory. A video of fewer frames yields them all.

        Args:
            count: at least 1.

        Yields:
            The frame's number, from 0, and the frame, BGR uint8 [height, width, 3], upright.
        """
        spacing = max(self.frames / count, 1.0)
        capture = cv2.VideoCapture(str(self.path))
        best: tuple[float, int, np.ndarray] | None = None
        part, number = 0, -1
        while capture.grab():
            number += 1
            if best is not None and int(number / spacing) > part:
                yield best[1:]
                best = None
            part = int(number / spacing)
            offset = (number + 0.5) / spacing - part - 0.5
            if spacing > 1 and abs(offset) > max(_WINDOW / 2, 0.5 / spacing):
                continue
            decoded, frame = capture.retrieve()
            if not decoded:
                continue
            sharpness = _sharpness(frame)
            if best is None or sharpness > best[0]:
                best = sharpness, number, frame
        capture.release()
        if best is not None:
            yield best[1:]


def _sharpness(frame: np.ndarray) -> float:
    """Variance of the Laplacian of the gray frame at a width of 480 pixels; motion blur lowers it, noise averages out.

    Pertuz et al. 2013, Analysis of focus measure operators for shape-from-focus.
    """
    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if gray.shape[1] > _SHARPNESS_WIDTH:
        height = round(gray.shape[0] * _SHARPNESS_WIDTH / gray.shape[1])
        gray = cv2.resize(gray, (_SHARPNESS_WIDTH, max(height, 1)), interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_64F).var())
