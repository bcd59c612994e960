"""The artifact in front of each photo of a dataset: as a run learned it, or as detection finds it without training."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Literal, Protocol

import numpy as np
import torch

from ssa_nerfstudio.cameras.groups import group_frames
from ssa_nerfstudio.cameras.lens import Lens, undistort, undistorted_lens
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.detection import Detection
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers, raw_layers, undistorted_layers
from ssa_nerfstudio.export.checkpoint import Checkpoint
from ssa_nerfstudio.export.restoration import MAX_ASPECT_DIFFERENCE, recoverable, restore, shows

Frame = Literal["raw", "undistorted"]


class CaptureArtifact(Protocol):
    """What is in front of the photos."""

    def covered(self, path: str, lens: Lens, frame: Frame) -> np.ndarray:
        """Pixels of a photo that the artifact changes: bool [H, W] of the frame.

        Args:
            path: of the photo, relative to the dataset; it says in which interval of the capture it lies.
            lens: its raw lens.
            frame: raw or undistorted.
        """
        ...

    def restored(self, photo: np.ndarray, path: str, lens: Lens, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """A photo uint8 [H, W, 3] of the frame without the artifact, and the pixels that were recovered, bool [H, W].

        A photo that does not show the artifact is returned as it is.

        Raises:
            InputError: the artifact's color is not known.
        """
        ...


class LearnedArtifact:
    """Of a run, from its checkpoint."""

    def __init__(self, checkpoint: Checkpoint, threshold: float) -> None:
        """Read the overlays.

        Args:
            checkpoint: of the run.
            threshold: matte above which a pixel is covered, in (0, 1).

        Raises:
            InputError: the run has no overlay.
        """
        self._threshold = threshold
        self._artifacts = checkpoint.artifacts()
        self._keys = [*self._artifacts.camera_keys.tolist(), *self._artifacts.bare_keys.tolist()]
        self._layers = {"undistorted": undistorted_layers(checkpoint), "raw": raw_layers(checkpoint)}
        self._sized = cache(self._of_frame)

    def covered(self, path: str, lens: Lens, frame: Frame) -> np.ndarray:
        """See `CaptureArtifact`."""
        layers = self._sized(self._group(path, lens), lens, frame)
        target = undistorted_lens(lens) if frame == "undistorted" else lens
        return np.zeros((target.height, target.width), bool) if layers is None else layers.covered(self._threshold)

    def restored(self, photo: np.ndarray, path: str, lens: Lens, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """See `CaptureArtifact`."""
        layers = self._sized(self._group(path, lens), lens, frame)
        if layers is None or not shows(photo, layers):
            return photo, np.ones(photo.shape[:2], bool)
        seen = recoverable(layers, self._threshold)
        return restore(photo, layers, seen)[0], seen

    def _group(self, path: str, lens: Lens) -> int:
        """The camera group of a photo."""
        target = undistorted_lens(lens)
        shape = _shape([target.width, target.height, target.fx, target.fy, target.cx, target.cy])
        shapes = [_shape(key) for key in self._keys]
        nearest = min(range(len(shapes)), key=lambda number: np.abs(shapes[number] - shape).max())
        if abs(shapes[nearest][0] / shape[0] - 1) > MAX_ASPECT_DIFFERENCE:
            raise InputError(
                f"a photo of {lens.width} x {lens.height} pixels is of no camera of the run",
                "give the dataset that the run was trained on",
            )
        return self._artifacts.at_photo(nearest, path)

    def _of_frame(self, group: int, lens: Lens, frame: Frame) -> ArtifactLayers | None:
        """The layers of a group at a photo's size; None where it has no artifact."""
        if group >= len(self._artifacts):
            return None
        size = undistorted_lens(lens) if frame == "undistorted" else lens
        return self._layers[frame][group].sized(size.width, size.height)


class DetectedArtifact:
    """Of detection alone: where the artifact is, not what it looks like."""

    def __init__(self, lenses: Sequence[Lens], detections: Sequence[Detection]) -> None:
        """Assign the detections to the cameras.

        Args:
            lenses: of all training photos, in the order that `evidence.capture_detection.read_cameras` has them.
            detections: of each camera, in its order.
        """
        groups = group_frames(np.array([(v.width, v.height, v.fx, v.fy, v.cx, v.cy) for v in lenses], dtype=np.float64))
        self._masks = {lens: detections[group].mask for lens, group in zip(lenses, groups, strict=True)}

    def covered(self, path: str, lens: Lens, frame: Frame) -> np.ndarray:
        """See `CaptureArtifact`."""
        mask = self._masks.get(lens, torch.zeros(lens.height, lens.width, dtype=torch.bool)).numpy()
        return undistort(mask.astype(np.float32), lens) > 0.5 if frame == "undistorted" else mask

    def restored(self, photo: np.ndarray, path: str, lens: Lens, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """See `CaptureArtifact`."""
        raise InputError("detection finds where the artifact is, not its color", "give --load-config of a training")


def _shape(camera: list[float]) -> np.ndarray:
    """Aspect, focal lengths and principal point of a camera, whatever its resolution."""
    width, height, fx, fy, cx, cy = camera
    return np.array([width / height, fx / width, fy / height, cx / width, cy / height])
