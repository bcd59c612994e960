"""Distant points of a capture behind its artifact, as the scene starts from them."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras

from ssa_nerfstudio.evidence.distant_points import DistantPoints, distant_points
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.camera_matching import group_cameras
from ssa_nerfstudio.plugin.exposure import Exposure
from ssa_nerfstudio.plugin.overlay_setup import views_of
from ssa_nerfstudio.plugin.settings import ModelSettings


@torch.no_grad()
def find_distant_seeds(
    config: ModelSettings,
    artifacts: Artifacts,
    photos: list[dict[str, Any]],
    cameras: Cameras,
    points: torch.Tensor | None,
    exposure: Exposure | None,
) -> tuple[DistantPoints, DistantPoints] | None:
    """Find them where an overlay is trained, which learns faster than splats that must first grow into the frame.

    Args:
        config: the model's.
        artifacts: the overlays, assigned to the photos.
        photos: the datamanager's undistorted cache.
        cameras: of the photos.
        points: of the scene [N, 3], from structure from motion; None where there are none.
        exposure: of the photos, where it is learned.

    Returns:
        What the photos show, and what they hide; None where nothing is looked for.
    """
    wanted = config.distant_seeds and config.overlay_start == "points" and not config.random_init
    if not wanted or not len(artifacts) or points is None or not len(points):
        return None
    gains = None if exposure is None else exposure.gains()
    views = views_of(photos, cameras, gains)
    of_groups = [artifacts[group].layers() for group in range(len(artifacts))]
    own = [artifacts.group_of_view(view) for view in range(len(views))]
    layers = [None if group is None else of_groups[group] for group in own]
    bare = group_cameras(cameras)[1]
    groups = [-1 - camera if group is None else group for camera, group in zip(bare, own, strict=True)]
    exposed = exposure is not None and exposure.place == "photo"
    return distant_points(points.to(views[0].image.device), views, layers, groups, exposed)
