"""Files of the true layers: T and B as float arrays, and as 8-bit pictures."""

from __future__ import annotations

import zipfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ssa_nerfstudio.experiments.effects.layers import Box, Layers


class LayerFile:
    """An .npz file of T and B for every camera of a rig, written one camera after the other.

    Keys are T and B where there is one camera, else T0, B0, T1, B1, ..., as `overlay: given` reads them.
    """

    def __init__(self, folder: Path, name: str, cameras: int) -> None:
        """Store where to write.

        Args:
            folder: exists.
            name: `raw` or `undistorted`.
            cameras: number of cameras that will be added.
        """
        self._folder, self._name, self._cameras = folder, name, cameras

    def add(self, camera: int, layers: Layers) -> None:
        """Write one camera's layers, float32 [H, W, 3] each, and PNG pictures of both (B clipped at 1)."""
        suffix = str(camera) if self._cameras > 1 else ""
        arrays = {"T": layers.transmittance, "B": layers.addition}
        # Most layers are constant almost everywhere and compress to a few percent; mud, the densest, to two thirds.
        path = self._folder / f"{self._name}.npz"
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for key, values in arrays.items():
                with archive.open(f"{key}{suffix}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, values, allow_pickle=False)
        for key, values in arrays.items():
            # OpenCV rounds and saturates at once; numpy would hold two more copies of the layer.
            picture = cv2.convertScaleAbs(values, alpha=255)
            Image.fromarray(picture).save(self._folder / f"{self._name}_{key}{suffix}.png", compress_level=1)


def write_view(path: Path, inside: Layers, box: Box, frame: tuple[int, int]) -> None:
    """Write the layers of one view: T and B inside a rectangle, as float16.

    Args:
        path: file to write; its folder is made where missing.
        inside: layers of the rectangle, representable in float16.
        box: the rectangle.
        frame: height and width of the raw frame, pixels.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    corner = np.array([box[0].start, box[1].start])
    halves = {"T": inside.transmittance.astype(np.float16), "B": inside.addition.astype(np.float16)}
    np.savez(path, corner=corner, frame=np.array(frame), **halves)
