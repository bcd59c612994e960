"""Seeds that structure from motion has not found: far away, in gaps, and behind what the artifact hides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras

from ssa_nerfstudio.evidence.distant_points import distant_points, horizon
from ssa_nerfstudio.evidence.gap_points import gap_points
from ssa_nerfstudio.evidence.scene_photos import ScenePhoto, scene_photos
from ssa_nerfstudio.evidence.seeds import Seeds
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.camera_matching import group_cameras
from ssa_nerfstudio.plugin.exposure import Exposure
from ssa_nerfstudio.plugin.overlay_setup import views_of
from ssa_nerfstudio.plugin.settings import ModelSettings


@dataclass(frozen=True)
class ExtraSeeds:
    """What a training has beside the points of structure from motion."""

    distant: Seeds
    """A sky and the like."""
    gaps: Seeds
    """Between the points, at their depth."""
    backdrop: Seeds
    """Far away, where the artifact or a mask hides the scene: for the end of the training."""

    def described(self) -> list[tuple[Seeds, str]]:
        """Those to start from, if there are any, and what a user is told of them."""
        sky = "far away, where photos show a sky or the like and the dataset has no points"
        gaps = "in gaps between the dataset's points, at the depth of those around"
        kinds = (self.distant, sky, "distant"), (self.gaps, gaps, "gap")
        text = "More Gaussians to start from: {:,} {}. (--pipeline.model.{}-seeds False leaves them out.)"
        return [(seeds, text.format(len(seeds), where, name)) for seeds, where, name in kinds if len(seeds)]


@torch.no_grad()
def find_extra_seeds(
    config: ModelSettings,
    artifacts: Artifacts,
    photos: list[dict[str, Any]],
    cameras: Cameras,
    points: torch.Tensor | None,
    exposure: Exposure | None,
) -> ExtraSeeds | None:
    """Find them where an overlay is trained, which learns faster than splats that must first grow into the frame.

    Args:
        config: the model's.
        artifacts: the overlays, assigned to the photos.
        photos: the datamanager's undistorted cache.
        cameras: of the photos.
        points: of the scene [N, 3], from structure from motion, outside all cameras; None where there are none.
        exposure: of the photos, where it is learned.

    Returns:
        The seeds, on the device of the photos; None where nothing is looked for.
    """
    wanted = (config.distant_seeds or config.gap_seeds) and config.overlay_start == "points" and not config.random_init
    if not wanted or not len(artifacts) or points is None or not len(points):
        return None
    of_scene = photos_of_scene(artifacts, photos, cameras, exposure)
    points = points.to(of_scene[0].color.device)
    return seeds_between(points, of_scene, config.distant_seeds, config.gap_seeds)


def seeds_between(
    points: torch.Tensor, photos: list[ScenePhoto], distant: bool = True, gaps: bool = True
) -> ExtraSeeds:
    """Those of one or both kinds.

    Args:
        points: of the scene [N, 3], world units, finite; at least one.
        photos: at least one.
        distant: look for distant ones.
        gaps: fill gaps, and what is hidden.
    """
    sphere, nothing = horizon(points, photos), Seeds.none(points)
    far = distant_points(points, photos, sphere) if distant else nothing
    between, hidden = nothing, nothing
    if gaps:
        between, hidden = gap_points(torch.cat([points, far.positions]), photos, sphere)
    return ExtraSeeds(far, between, hidden)


@torch.no_grad()
def photos_of_scene(
    artifacts: Artifacts, photos: list[dict[str, Any]], cameras: Cameras, exposure: Exposure | None
) -> list[ScenePhoto]:
    """Photos without the artifact that each has, for arguments as of `find_extra_seeds`."""
    gains = None if exposure is None else exposure.gains()
    views = views_of(photos, cameras, gains)
    of_groups = [artifacts[group].layers() for group in range(len(artifacts))]
    own = [artifacts.group_of_view(view) for view in range(len(views))]
    layers = [None if group is None else of_groups[group] for group in own]
    bare = group_cameras(cameras)[1]
    groups = [-1 - camera if group is None else group for camera, group in zip(bare, own, strict=True)]
    exposed = exposure is not None and exposure.place == "photo"
    return scene_photos(views, layers, groups, exposed)
