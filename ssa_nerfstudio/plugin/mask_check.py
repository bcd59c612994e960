"""Masks of the dataset that leave training nothing to learn from."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import torch

from ssa_nerfstudio.cameras.camera_names import camera_names
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.mask_polarity import check_polarity
from ssa_nerfstudio.evidence.statistics import accumulate

_LOG = logging.getLogger(__name__)

_MIN_USED = 0.05
"""Share of the frame that masks keep, at least, unless they are of the other polarity."""
_MAX_PHOTOS = 64
_REMEDY = "invert the masks: black is ignored"


def check_masks(photos: list[dict[str, Any]], groups: list[int], names: Sequence[str]) -> None:
    """Check that each camera's masks keep the scene.

    A mask that is the same in all photos of a camera is one of the artifact, and compared with what is detected. Masks
    that differ, as those of people, are not.

    Args:
        photos: the datamanager's cache, in the order of the capture.
        groups: each photo's camera group.
        names: of the photos, relative to the dataset.

    Raises:
        InputError: a camera's only mask leaves nearly nothing, or keeps the artifact alone. Where that is only likely,
            a warning is logged.
    """
    members = [[index for index, at in enumerate(groups) if at == group] for group in sorted({*groups})]
    cameras = camera_names([[names[index] for index in each] for each in members])
    for camera, indices in zip(cameras, members, strict=True):
        views = [photos[index] for index in indices]
        if any(photo.get("mask") is None for photo in views):
            continue
        masks = [photo["mask"][..., 0] != 0 for photo in views]
        name = "the mask" if len(members) == 1 else f"the mask of {camera}"
        used, same = float(sum(mask.float().mean() for mask in masks)) / len(masks), _all_equal(masks)
        if used < _MIN_USED:
            problem = f"{name} keeps {used:.1%} of the frame"
            if same:
                raise InputError(problem, _REMEDY)
            _LOG.warning(f"{problem}, mean over the photos; if it should keep the rest, {_REMEDY}")
        elif same and used < 1:
            step = -(-len(views) // _MAX_PHOTOS)
            statistics = accumulate((photo["image"], None) for photo in views[::step])
            check_polarity(masks[0].cpu().numpy(), statistics, name, _REMEDY)


def _all_equal(masks: list[torch.Tensor]) -> bool:
    return all(torch.equal(mask, masks[0]) for mask in masks[1:])
