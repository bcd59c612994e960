"""What photos show of the scene: at the working resolution, with the artifact taken off and at one exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.point_samples import View, project, working_pixels, working_reduction
from ssa_nerfstudio.evidence.statistics import FULL_SCALE
from ssa_nerfstudio.overlay.layer import HIDDEN_BELOW

MAX_VIEWS = 128
"""Views that are read; of more a regular subset, group by group."""
MIN_SHOWN = 0.5
"""Transmittance of the artifact below which a pixel does not count."""


@dataclass(frozen=True)
class ScenePhoto:
    """What one photo shows of the scene."""

    view: View
    """Its camera."""
    group: int
    """Photos of one group have the same camera and the same artifact."""
    color: Tensor
    """[h, w, 3] in [0, 1], working pixels."""
    shown: Tensor
    """[h, w, 1] bool: no mask is there, and no artifact that hides more than half of the scene."""
    hidden: Tensor
    """[h, w, 1] bool: a mask is there, or an artifact that hides nearly all of the scene."""
    reduction: int
    """Photo pixels a working pixel."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the working frame."""
        height, width = self.shown.shape[:2]
        return height, width


def scene_photos(
    views: Sequence[View],
    layers: Sequence[tuple[Tensor, Tensor] | None],
    groups: Sequence[int],
    artifact_is_exposed: bool = False,
) -> list[ScenePhoto]:
    """Reduce photos, take the artifact off, C = (I - B) / T, and divide by their gains.

    Args:
        views: at least one.
        layers: of each view's artifact, T [H, W, 1 or 3] and B [H, W, 3]; None where it has none. Views with the same
            artifact have the same tuple.
        groups: of each view: views of one group have the same camera and the same artifact.
        artifact_is_exposed: views' gains act on scene and artifact together, and not on the scene alone.

    Returns:
        At most MAX_VIEWS of them, group by group.
    """
    by_group = sorted(range(len(views)), key=lambda view: groups[view])
    kept = by_group[:: -(-len(views) // MAX_VIEWS)]
    artifacts = {id(pair): _reduced_layers(pair, views[view]) for view in kept if (pair := layers[view])}
    return [
        _scene_photo(views[view], groups[view], artifacts.get(id(layers[view])), artifact_is_exposed) for view in kept
    ]


def pixels_of(positions: Tensor, photo: ScenePhoto) -> tuple[Tensor, Tensor]:
    """Indices [M] of the positions [N, 3] in the frame of a photo, and their working pixels [M], row by row."""
    height, width = photo.size
    poses, lenses = photo.view.world_to_camera[None], photo.view.intrinsics[None]
    _, index, position, _ = project(positions, poses, lenses, height * photo.reduction, width * photo.reduction)
    return index, working_pixels(position, photo.size, photo.reduction)


def near_points(points: Tensor, photo: ScenePhoto, radius: int) -> Tensor:
    """[h, w] bool: within a radius, working pixels, of one of the points [N, 3], hidden or not."""
    height, width = photo.size
    taken = torch.zeros(height * width, device=points.device)
    taken[pixels_of(points, photo)[1]] = 1
    return nn.functional.max_pool2d(taken.reshape(1, height, width), 2 * radius + 1, 1, radius)[0] > 0


def _reduced_layers(layers: tuple[Tensor, Tensor], view: View) -> tuple[Tensor, Tensor]:
    """T [h, w, 1] and B [h, w, 3] at the working resolution, on the device of the photos."""
    reduction = working_reduction(*view.image.shape[:2])
    transmittance, addition = (reduced(layer, reduction).to(view.image.device) for layer in layers)
    return transmittance.mean(dim=-1, keepdim=True), addition


def _scene_photo(view: View, group: int, layers: tuple[Tensor, Tensor] | None, artifact_is_exposed: bool) -> ScenePhoto:
    height, width = view.image.shape[:2]
    reduction = working_reduction(height, width)
    color = reduced(view.image[..., :3].float(), reduction) / FULL_SCALE.get(view.image.dtype, 1.0)
    gain = torch.ones_like(color[0, 0]) if view.gain is None else view.gain.to(color)
    shown = torch.ones_like(color[..., :1], dtype=torch.bool)
    if view.mask is not None:
        shown &= reduced((view.mask.reshape(height, width, 1) != 0).to(color), reduction) == 1
    hidden = ~shown
    if layers is not None:
        transmittance, addition = layers
        shown &= transmittance >= MIN_SHOWN
        hidden |= transmittance < HIDDEN_BELOW
        color = color - (gain if artifact_is_exposed else 1.0) * addition
        color = color / transmittance.clamp_min(MIN_SHOWN)
    return ScenePhoto(view, group, (color / gain).clamp(0, 1), shown, hidden, reduction)
