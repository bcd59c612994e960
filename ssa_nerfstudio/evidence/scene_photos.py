"""What photos show of the scene: at the working resolution, with the artifact taken off and at one exposure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import torch
from torch import Tensor, nn

from ssa_nerfstudio.evidence.guided_upsampling import reduced
from ssa_nerfstudio.evidence.point_samples import View, photos_at_once, project, working_pixels, working_reduction
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
    of_artifacts = {id(pair): (pair, views[view]) for view in kept if (pair := layers[view])}
    artifacts = {key: _reduced_layers(*artifact) for key, artifact in of_artifacts.items()}
    return [
        _scene_photo(views[view], groups[view], artifacts.get(id(layers[view])), artifact_is_exposed) for view in kept
    ]


@dataclass(frozen=True)
class Projections:
    """Which of N positions are in the frames of some photos of one size: M pairs, photo by photo."""

    photos: Sequence[ScenePhoto]
    """V of them."""
    first: int
    """Number of the first among all."""
    view: Tensor
    """[M] int64 in [0, V): the photo."""
    index: Tensor
    """[M] int64: the position."""
    pixel: Tensor
    """[M] int64: working pixel, row by row."""

    def read(self, pictures: Sequence[Tensor]) -> Tensor:
        """Values [M, C] of pictures [h, w, C], one for each of all photos."""
        own = torch.stack(list(pictures[self.first : self.first + len(self.photos)])).to(self.pixel.device)
        return own.flatten(1, 2)[self.view, self.pixel]


def projections(positions: Tensor, photos: Sequence[ScenePhoto]) -> Iterator[Projections]:
    """Of positions [N, 3] into photos; into many at a time on a GPU, which waits for its host."""
    first = 0
    for (size, reduction), run in groupby(photos, key=lambda photo: (photo.size, photo.reduction)):
        alike = list(run)
        at_once = photos_at_once(positions.device, positions.numel())
        for some in (alike[start : start + at_once] for start in range(0, len(alike), at_once)):
            poses = torch.stack([photo.view.world_to_camera for photo in some])
            lenses = torch.stack([photo.view.intrinsics for photo in some])
            view, index, place, _ = project(positions, poses, lenses, size[0] * reduction, size[1] * reduction)
            yield Projections(some, first, view, index, working_pixels(place, size, reduction))
            first += len(some)


def near_points(points: Tensor, photos: Sequence[ScenePhoto], radius: int) -> list[Tensor]:
    """For each photo [h, w, 1] bool: within a radius, working pixels, of one of the points [N, 3], hidden or not."""
    near: list[Tensor] = []
    for seen in projections(points, photos):
        height, width = seen.photos[0].size
        taken = torch.zeros(len(seen.photos), height * width, device=points.device)
        taken[seen.view, seen.pixel] = 1
        widened = nn.functional.max_pool2d(taken.reshape(-1, height, width), 2 * radius + 1, 1, radius)
        near.extend((widened > 0)[..., None])
    return near


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
