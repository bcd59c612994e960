"""Files of the true layers: T and B as float arrays, and as 8-bit pictures."""

from __future__ import annotations

import zipfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ssa_nerfstudio.experiments.effects.layers import Box, Layers


def add_layers(folder: Path, suffix: str, name: str, layers: Layers) -> None:
    """Add one camera's layers to NAME.npz, as `overlay: given` reads them, and PNG pictures of both (B clipped at 1).

    Args:
        folder: exists.
        suffix: the camera's number, with which the keys T and B end; empty where there is one camera.
        name: `raw` or `undistorted`.
        layers: T and B, float32 [H, W, 3] each.
    """
    arrays = {f"T{suffix}": layers.transmittance, f"B{suffix}": layers.addition}
    # Most layers are constant almost everywhere and compress to a few percent; mud, the densest, to two thirds.
    with zipfile.ZipFile(folder / f"{name}.npz", "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key, values in arrays.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
    for key, values in arrays.items():
        # OpenCV rounds and saturates at once; numpy would hold two more copies of the layer.
        picture = cv2.convertScaleAbs(values, alpha=255)
        Image.fromarray(picture).save(folder / f"{name}_{key}.png", compress_level=1)


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
