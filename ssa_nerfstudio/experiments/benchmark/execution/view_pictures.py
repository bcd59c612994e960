"""Small pictures of a finished run: a test view, its render, the artifact learned and its matte."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ssa_nerfstudio.overlay.rgba import over_checkerboard
from ssa_nerfstudio.plugin.pipeline import SSAPipeline

WIDEST = 480
"""Longest side, pixels."""
TITLES = {
    "photo": "training photo",
    "test": "test photo",
    "render": "clean render",
    "artifact": "artifact learned",
    "matte": "matte",
}
"""Name of the file to what it shows, in a sheet's order."""


@torch.no_grad()
def take(pipeline: SSAPipeline, folder: Path) -> None:
    """Writes JPEGs, `TITLES` telling which, of the middle training and the middle test view."""
    pipeline.eval()
    photos = pipeline.datamanager.cached_train
    camera, batch = pipeline.datamanager.fixed_indices_eval_dataloader[len(pipeline.datamanager.eval_dataset) // 2]
    drawn = pipeline.model.get_outputs_for_camera(camera)
    pictures = {
        "photo": photos[len(photos) // 2]["image"],
        "test": batch["image"],
        "render": drawn["rgb"],
    }
    if "overlay_alpha" in drawn:
        pictures["artifact"] = over_checkerboard(drawn["overlay_rgb"], drawn["overlay_alpha"])
        pictures["matte"] = drawn["overlay_alpha"].expand_as(drawn["rgb"])
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in pictures.items():
        picture = Image.fromarray(np.rint(_array(values) * 255).astype(np.uint8))
        picture.thumbnail((WIDEST, WIDEST), Image.Resampling.BOX)
        picture.save(folder / f"{name}.jpg", quality=88)


def _array(image: Tensor) -> np.ndarray:
    values = image.cpu().float() / 255.0 if image.dtype == torch.uint8 else image.cpu().float()
    return values[..., :3].clamp(0, 1).numpy()
