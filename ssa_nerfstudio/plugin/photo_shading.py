"""Shading: in each photo the artifact has a light of its own, whose mean over the photos is that of its overlay.

A finger or a part of the camera's rig keeps its shape while the camera moves, and the light on it changes. One overlay
for all photos leaves that unexplained, and the scene learns it where it comes through.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.artifact_light import MAX_COEFFICIENT, artifact_light
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.resampling import to_training_scale
from ssa_nerfstudio.overlay.shading import COEFFICIENTS, light, shading_basis
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.decisions import tell


class Shading(nn.Module):
    """The light on the artifact in all training photos. Any other photo has the mean light."""

    coefficients: Parameter
    """[V, 5], see `overlay.shading`. Their means over the photos of an overlay are 0."""

    def __init__(self, photos: int) -> None:
        """Start from the same light in all photos.

        Args:
            photos: their number V.
        """
        super().__init__()
        self.coefficients = Parameter(torch.zeros(photos, COEFFICIENTS))
        self.photos: list[str] = []
        """The photos' paths relative to the dataset."""
        self._group_of_view = [0] * photos
        self._groups = torch.zeros(photos, dtype=torch.long)  # on the device of the coefficients from `project` on
        self._bases: dict[tuple[int, int], Tensor] = {}

    def assign(self, artifacts: Artifacts, photos: list[str]) -> None:
        """Tell whose light it is.

        Args:
            artifacts: the overlays of the training photos.
            photos: the photos' paths relative to the dataset.
        """
        self.photos = photos
        groups = [artifacts.group_of_view(view) for view in range(len(photos))]
        bare = len(artifacts)  # a group of its own, without a gradient
        self._group_of_view = [bare if group is None else group for group in groups]
        self._groups = torch.tensor(self._group_of_view)

    @torch.no_grad()
    def start_from(self, artifacts: Artifacts, cache: list[dict[str, Any]]) -> None:
        """Start from how the photos differ where the artifact hides the scene.

        Args:
            artifacts: the initial overlays.
            cache: the datamanager's undistorted photos, in the order of `assign`.
        """
        for group, overlay in enumerate(artifacts.learned()):
            views = [view for view, of in enumerate(self._group_of_view) if of == group]
            images, masks = [cache[view]["image"] for view in views], [cache[view].get("mask") for view in views]
            found = artifact_light(images, masks, _basis(overlay, 1), overlay.layers()[1])
            self.coefficients[views] = found.to(self.coefficients)

    def of_view(self, view: int, overlay: ScreenSpaceOverlay, reduction: int) -> Tensor:
        """The factor of B in a training photo, [H // reduction, W // reduction, 3], above 0."""
        key = self._group_of_view[view], reduction
        if key not in self._bases:
            # Of one resolution: that of a training only rises.
            self._bases = {known: basis for known, basis in self._bases.items() if known[1] == reduction}
            self._bases[key] = _basis(overlay, reduction)
        return light(self._bases[key], self.coefficients[view])

    @torch.no_grad()
    def project(self) -> None:
        """Subtract the means over the photos of each overlay, which so has their mean light; then bound all."""
        self._groups = self._groups.to(self.coefficients.device)
        sums = self.coefficients.new_zeros(max(self._group_of_view) + 1, COEFFICIENTS + 1)
        ones = torch.ones_like(self.coefficients[:, :1])
        sums.index_add_(0, self._groups, torch.cat([self.coefficients, ones], dim=1))
        self.coefficients.sub_((sums[:, :-1] / sums[:, -1:].clamp_min(1))[self._groups])
        self.coefficients.clamp_(-MAX_COEFFICIENT, MAX_COEFFICIENT)

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint holds beside the coefficients."""
        return {"photos": self.photos}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take what a checkpoint holds."""
        self.photos = list(state["photos"])


def started(
    shading: Shading | None,
    artifacts: Artifacts,
    photos: list[str],
    cache: list[dict[str, Any]] | None,
    resumed: bool,
) -> Shading | None:
    """The shading of a model whose overlays are there.

    Args:
        shading: the model's.
        artifacts: its overlays.
        photos: the training photos' paths relative to the dataset.
        cache: the datamanager's undistorted photos, which it starts from; None: from the same light in all photos.
        resumed: a checkpoint, which is loaded later, holds the overlays and their light.

    Returns:
        None where no overlay is learned, or none hides anything as it starts, so that a light would change nothing.
    """
    if shading is None or not artifacts.learned():
        return None
    if not resumed and not any((overlay.evidence < 1).any() for overlay in artifacts.learned()):
        tell("The artifact hides nothing as the training starts: it has the same light in all photos.")
        return None
    shading.assign(artifacts, photos)
    if cache is not None:
        shading.start_from(artifacts, cache)
    return shading


def of_checkpoint(shading: Shading | None, state: dict[str, Any], prefix: str, training: bool) -> Shading | None:
    """The shading of a model that loads a checkpoint: what is only rendered has the mean light, and needs none.

    Args:
        shading: the model's.
        state: the model's state dict, from which entries are dropped that are not needed.
        prefix: of the shading's entries in it.
        training: whether the model goes on from the checkpoint.

    Raises:
        InputError: one of the two has no shading, or the checkpoint has that of other photos.
    """
    if not training:
        for name in [name for name in state if name.startswith(prefix)]:
            del state[name]
        return None
    saved = state.get(f"{prefix}coefficients")
    if (saved is None) != (shading is None):
        there, setting = ("no", "off") if saved is None else ("a", "affine")
        raise InputError(
            f"the checkpoint has {there} shading of the artifact, this run's setting is another",
            f"resume with --pipeline.model.shading {setting}",
        )
    if shading is not None and saved is not None and state[f"{prefix}_extra_state"]["photos"] != shading.photos:
        raise InputError(
            f"the checkpoint has the shading of {len(saved)} photos, and this run's {len(shading.photos)} are not "
            "the same in the same order",
            "resume with the photos it was trained with",
        )
    return shading


def _basis(overlay: ScreenSpaceOverlay, reduction: int) -> Tensor:
    """[H // reduction, W // reduction, 3] of the overlay's opacity as the training started, which checkpoints hold."""
    basis = shading_basis(1 - overlay.evidence)
    return to_training_scale(basis, overlay.resolution, reduction, overlay.height, overlay.width)
