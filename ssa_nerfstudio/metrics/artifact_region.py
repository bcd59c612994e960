"""Where a real artifact is, by a mask of the raw frame: metrics of a view and mattes, inside and outside of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from ssa_nerfstudio.cameras.lens import Lens, undistort
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.metrics import image as metrics

MARGIN = 16
"""Pixels of a raw photo that the mask is dilated by: JPEG mixes the colors of blocks of 16 x 16."""


@dataclass(frozen=True)
class ArtifactRegion:
    """The region in the undistorted frame, [H, W] bool each."""

    inside: Tensor
    """Where the artifact may be."""
    outside: Tensor
    """What is farther from it than MARGIN."""

    @classmethod
    def read(cls, path: Path, lens: Lens) -> ArtifactRegion:
        """Read a mask of the raw frame, white on the artifact, and warp it as photos are warped.

        Args:
            path: a picture; one of another size than the lens' frame is averaged over areas.
            lens: the raw frame's.

        Raises:
            InputError: the file cannot be read.
        """
        try:
            full = np.asarray(Image.open(path).convert("L"), np.float32) / 255
        except (OSError, UnidentifiedImageError) as error:
            raise InputError(
                f"{path} cannot be read as a mask ({error})", "give a picture, white on the artifact"
            ) from error
        radius = max(1, round(MARGIN * lens.width / full.shape[1]))
        raw = cv2.resize(full, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        inside = undistort(raw, lens) > 0.5
        outside = undistort(cv2.dilate((raw > 0).astype(np.float32), disk), lens) == 0
        return cls(torch.from_numpy(inside), torch.from_numpy(outside))

    def view_metrics(self, outputs: Mapping[str, Tensor], target: Tensor) -> dict[str, float]:
        """PSNR of the clean render, dB: outside_psnr, and inside_psnr, which says something where the photo is clean.

        Args:
            outputs: the model's, of the whole undistorted frame.
            target: the photo [H, W, 3] in [0, 1].
        """
        render = outputs["rgb"]
        regions = {"outside_psnr": self.outside, "inside_psnr": self.inside}
        return {
            name: metrics.psnr(render[chosen][None], target[chosen][None])
            for name, region in regions.items()
            if (chosen := region.to(render.device)).any()
        }

    def mattes(self, matte: Tensor | None) -> dict[str, float]:
        """Mean matte inside, outside, and outside in the upper third of the frame, where the sky is in most captures.

        Args:
            matte: [H', W'] in [0, 1], of any resolution; None: there is no overlay, and all are 0.
        """
        size = self.inside.shape if matte is None else matte.shape
        matte = torch.zeros(size) if matte is None else matte.cpu()
        # The share of an overlay's pixel that belongs to the region counts.
        inside, outside = (
            F.interpolate(region.float()[None, None], size=tuple(size), mode="area")[0, 0]
            for region in (self.inside, self.outside)
        )
        third = len(matte) // 3
        return {
            "matte_inside": _mean(matte, inside),
            "matte_outside": _mean(matte, outside),
            "matte_upper_third": _mean(matte[:third], outside[:third]),
        }


def _mean(matte: Tensor, weight: Tensor) -> float:
    total = float(weight.sum())
    return float((matte * weight).sum()) / total if total else 0.0
