"""A trained artifact as layers T and B (I = T C + B), in the undistorted or raw frame and at any resolution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import scipy.ndimage
import torch

from ssa_nerfstudio.cameras.intervals import BEGINNING
from ssa_nerfstudio.cameras.lens import Lens, distort, undistorted_lens
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.checkpoint import Checkpoint
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.resampling import straight_color
from ssa_nerfstudio.plugin.camera_matching import lens as lens_of

_MIN_KNOWN_WEIGHT = 0.999
"""Weight of known pixels from which a resampled pixel counts as known."""


@dataclass(frozen=True)
class ArtifactLayers:
    """The artifact of one camera."""

    transmittance: np.ndarray
    """T: float32 [H, W, 3] in [0, 1]."""
    addition: np.ndarray
    """B: float32 [H, W, 3], not negative."""
    camera: Lens
    """Intrinsics of the frame that the layers are in; of an equirectangular one the scale in its middle."""
    frame: Literal["undistorted", "raw", "equirectangular"]
    """undistorted: the frame that nerfstudio trains in; raw: that of the original photos; equirectangular: that of the
    360 degree photos whose faces were trained on."""
    kind: Literal["learned", "given"]
    name: str = "camera_0"
    """Of the camera, or of its interval (`Artifacts.name`)."""
    start: str = BEGINNING
    """The interval's first photo, relative to the dataset."""
    known: np.ndarray | None = None
    """bool [H, W]: False outside the cropped undistorted frame or the faces, where nothing was learned; None: all is
    known."""

    def straight(self) -> tuple[np.ndarray, np.ndarray]:
        """Straight color W [H, W, 3] and matte A [H, W, 1], both in [0, 1]."""
        color, alpha = straight_color(torch.from_numpy(self.transmittance), torch.from_numpy(self.addition))
        return color.numpy(), alpha.numpy()

    def covered(self, threshold: float) -> np.ndarray:
        """Pixels whose matte exceeds the threshold, bool [H, W]; unknown pixels are like the nearest known one.

        A dashboard does not end where the undistorted frame does, and structure from motion must not use it there.
        """
        covered = self.straight()[1][..., 0] > threshold
        if self.known is None or self.known.all():
            return covered
        y, x = np.asarray(
            scipy.ndimage.distance_transform_edt(~self.known, return_distances=False, return_indices=True)
        )
        return covered[y, x]

    def sized(self, width: int, height: int) -> ArtifactLayers:
        """Resample to another resolution: bilinearly, or by area where it is smaller."""
        if (width, height) == (self.camera.width, self.camera.height):
            return self
        across, down = width / self.camera.width, height / self.camera.height
        method = cv2.INTER_AREA if across < 1 else cv2.INTER_LINEAR
        transmittance, addition = (
            cv2.resize(plane, (width, height), interpolation=method) for plane in (self.transmittance, self.addition)
        )
        c = self.camera
        camera = Lens(width, height, c.fx * across, c.fy * down, c.cx * across, c.cy * down, c.distortion, c.model)
        known = self.known
        if known is not None:
            known = cv2.resize(known.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
        return ArtifactLayers(transmittance, addition, camera, self.frame, self.kind, self.name, self.start, known)


def undistorted_layers(checkpoint: Checkpoint) -> list[ArtifactLayers]:
    """Artifact of every camera group in the frame that it was trained in.

    Raises:
        InputError: the checkpoint has no overlay.
    """
    artifacts = checkpoint.artifacts()
    result = []
    for group, key in enumerate(artifacts.camera_keys.tolist()):
        overlay = artifacts[group]
        with torch.no_grad():
            transmittance, addition = (layer.expand(-1, -1, 3).numpy().copy() for layer in overlay.layers())
        kind = "learned" if isinstance(overlay, ScreenSpaceOverlay) else "given"
        width, height, *intrinsics = key
        camera = Lens(int(width), int(height), *intrinsics)
        result.append(
            ArtifactLayers(
                transmittance, addition, camera, "undistorted", kind, artifacts.name(group), artifacts.starts[group]
            )
        )
    return result


def raw_layers(checkpoint: Checkpoint) -> list[ArtifactLayers]:
    """Artifact of every camera group in the raw frame of its photos, through the lens distortion.

    Outside the cropped undistorted frame the layers are clear and not known.

    Raises:
        InputError: the checkpoint states no lenses, or nerfstudio cannot undistort them.
    """
    described = checkpoint.artifacts().lenses.tolist()
    if not described:
        raise InputError(
            f"{checkpoint.path} was written before checkpoints kept their lenses: the raw frame is not known",
            "resume the run for one more step, or use the undistorted frame",
        )
    result = []
    for layers, row in zip(undistorted_layers(checkpoint), described, strict=True):
        try:
            lens = lens_of(row)
            target = undistorted_lens(lens)
        except ValueError as error:
            raise InputError(f"{checkpoint.path}: {error}", "use the undistorted frame") from error
        if (target.width, target.height) != (layers.camera.width, layers.camera.height):
            raise InputError(
                f"{checkpoint.path}: the overlay is {layers.camera.width} x {layers.camera.height}, its lens gives "
                f"{target.width} x {target.height}",
                "use the undistorted frame",
            )
        transmittance = distort(layers.transmittance, lens, 1.0)
        addition = distort(layers.addition, lens, 0.0)
        known = distort(np.ones((target.height, target.width), np.float32), lens, 0.0) > _MIN_KNOWN_WEIGHT
        result.append(
            ArtifactLayers(transmittance, addition, lens, "raw", layers.kind, layers.name, layers.start, known)
        )
    return result
