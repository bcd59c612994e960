"""What faces of a panorama know of each other's artifacts: neighbors see the same directions where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch

from ssa_nerfstudio.cameras.panorama import Face, hidden_by_neighbors
from ssa_nerfstudio.data.panorama_entry import Panorama
from ssa_nerfstudio.evidence.initialization import initialize_as
from ssa_nerfstudio.evidence.point_samples import working_reduction
from ssa_nerfstudio.evidence.static_area import MIN_AREA
from ssa_nerfstudio.overlay.layer import OPTIONAL_BUFFERS, ScreenSpaceOverlay

HIDDEN = 0.5
"""Transmittances below this hide the scene."""


def faces_of(panorama: Panorama, keys: torch.Tensor) -> list[Face] | None:
    """The face that each camera of a dataset is, by its focal length.

    Args:
        panorama: that they were cut out of.
        keys: of the cameras, [G, 6] (`camera_matching.group_cameras`).

    Returns:
        One for each camera, at the size of its photos; None if the cameras are not faces of one size, one each.
    """
    size, sizes = int(keys[0, 0]), keys[:, :2]
    candidates = [Face(face.name, size) for face in panorama.faces]
    nearest = [min(candidates, key=lambda face, fx=float(key[2]): abs(face.focal - fx)) for key in keys]
    return nearest if (sizes == size).all() and len({*nearest}) == len(nearest) else None


@torch.no_grad()
def joined_overlays(
    faces: Sequence[Face], overlays: Sequence[ScreenSpaceOverlay | None], resolution: Literal[1, 2, 4]
) -> dict[int, ScreenSpaceOverlay]:
    """Overlays of faces that start with what hides the scene in their neighbors, where these overlap with them.

    Args:
        faces: all of one size.
        overlays: of the faces as they start alone; None where a face has none.
        resolution: of overlays (`ScreenSpaceOverlay`).

    Returns:
        By the face's number: of those faces alone whose own overlay, or the lack of one, misses a part of that. What
        else is known of a face's photos (OPTIONAL_BUFFERS of its own overlay) stays.
    """
    clear = np.tile(np.array([1, 0, 0, 0], np.float32), (faces[0].size, faces[0].size, 1))
    known = {
        face: torch.cat(overlay.before_falloff(), dim=-1).cpu().numpy()
        for face, overlay in zip(faces, overlays, strict=True)
        if overlay is not None
    }
    smallest = MIN_AREA * working_reduction(*clear.shape[:2]) ** 2
    joined = {}
    for number, (face, overlay) in enumerate(zip(faces, overlays, strict=True)):
        own, others = known.get(face, clear), [(other, layers) for other, layers in known.items() if other != face]
        beside = hidden_by_neighbors(face, others)
        if ((beside[..., 0] < HIDDEN) & (own[..., 0] >= HIDDEN)).sum() >= smallest:
            adds_light = overlay is not None and overlay.adds_light
            joined[number] = ScreenSpaceOverlay(face.size, face.size, resolution, adds_light)
            both = np.where(beside[..., :1] < own[..., :1], beside, own)
            initialize_as(joined[number], torch.from_numpy(both))
            for name in OPTIONAL_BUFFERS if overlay is not None else ():
                setattr(joined[number], name, getattr(overlay, name).to(joined[number].evidence, copy=True))
    return joined
