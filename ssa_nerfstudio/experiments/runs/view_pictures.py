"""Pictures of a finished run: a test view, its render, the artifact learned and its matte."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ssa_nerfstudio.overlay.rgba import over_checkerboard
from ssa_nerfstudio.plugin.pipeline import SSAPipeline

WIDEST = 480
"""Longest side of a stored picture, pixels."""


@torch.no_grad()
def view_pictures(pipeline: SSAPipeline) -> dict[str, np.ndarray]:
    """Pictures [H, W, 3] in [0, 1] of the middle training and the middle test view.

    Returns:
        photo (of the training), test (photo) and its render; where there is an overlay also the artifact that was
        learned, over a checkerboard, and its matte.
    """
    pipeline.eval()
    photos = pipeline.datamanager.cached_train
    camera, batch = pipeline.datamanager.fixed_indices_eval_dataloader[len(pipeline.datamanager.eval_dataset) // 2]
    drawn = pipeline.model.get_outputs_for_camera(camera)
    pictures = {"photo": photos[len(photos) // 2]["image"], "test": batch["image"], "render": drawn["rgb"]}
    if "overlay_alpha" in drawn:
        pictures["artifact"] = over_checkerboard(drawn["overlay_rgb"], drawn["overlay_alpha"])
        pictures["matte"] = drawn["overlay_alpha"].expand_as(drawn["rgb"])
    return {name: _array(image) for name, image in pictures.items()}


def write_view_pictures(pipeline: SSAPipeline, folder: Path) -> None:
    """Write `view_pictures` as small JPEGs of their names."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in view_pictures(pipeline).items():
        picture = Image.fromarray(np.rint(values * 255).astype(np.uint8))
        picture.thumbnail((WIDEST, WIDEST), Image.Resampling.BOX)
        picture.save(folder / f"{name}.jpg", quality=88)


def _array(image: Tensor) -> np.ndarray:
    values = image.cpu().float() / 255.0 if image.dtype == torch.uint8 else image.cpu().float()
    return values[..., :3].clamp(0, 1).numpy()
