"""Shading: in each photo the artifact has a light of its own, whose mean over the photos is that of its overlay.

A finger or a part of the camera's rig keeps its shape while the camera moves, and the light on it changes. One overlay
for all photos leaves that unexplained, and the scene learns it where it comes through.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.artifact_light import MAX_COEFFICIENT, artifact_light, changing_light
from ssa_nerfstudio.overlay.layer import ScreenSpaceOverlay
from ssa_nerfstudio.overlay.shading import COEFFICIENTS, ShadingSetting, basis_of, light
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.decisions import tell
from ssa_nerfstudio.plugin.training.checkpoints import load_pipeline_state


class Shading(nn.Module):
    """The light on the artifact in training photos that have one of their own. Any other photo has the mean light."""

    coefficients: Parameter
    """[R, 5] of those photos, see `overlay.shading`. Their means over the photos of an overlay are 0."""

    def __init__(self, views: dict[int, int], names: list[str], coefficients: Tensor) -> None:
        """Start from known light.

        Args:
            views: training view of each of the R photos, and the group of its overlay.
            names: the photos' paths relative to the dataset, of all training views.
            coefficients: [R, 5], on the model's device.
        """
        super().__init__()
        self.coefficients = Parameter(coefficients)
        self.photos = [names[view] for view in views]
        """The photos' paths relative to the dataset."""
        self._row_of_view = {view: row for row, view in enumerate(views)}
        self._groups = torch.tensor(list(views.values()), device=coefficients.device)
        self._photos_of_groups = torch.bincount(self._groups).clamp_min(1)[:, None]
        self._group_of_view = views
        self._bases: dict[tuple[int, int], Tensor] = {}
        self._slopes: Tensor | None = None

    def of_view(self, view: int) -> Tensor | None:
        """The coefficients [5] of a training photo; None where it has the mean light."""
        row = self._row_of_view.get(view)
        return None if row is None else self.coefficients[row]

    def light(self, view: int, coefficients: Tensor, overlay: ScreenSpaceOverlay, reduction: int) -> Tensor:
        """The factor of B in a training photo, [H // reduction, W // reduction, 3], above 0.

        Args:
            view: the photo's.
            coefficients: its own [5].
            overlay: the one that the photo shows.
            reduction: factor by which training images are reduced.
        """
        key = self._group_of_view[view], reduction
        if key not in self._bases:
            # Of one resolution: that of a training only rises.
            self._bases = {known: basis for known, basis in self._bases.items() if known[1] == reduction}
            self._bases[key] = basis_of(overlay, reduction)
        return light(self._bases[key], coefficients)

    def add_gradient(self, view: int, gradient: Tensor) -> None:
        """Add the gradient of a photo's coefficients [5] to that of all, which stays where it is in memory."""
        if self.coefficients.grad is None:
            self._slopes = torch.zeros_like(self.coefficients) if self._slopes is None else self._slopes.zero_()
            self.coefficients.grad = self._slopes
        self.coefficients.grad[self._row_of_view[view]] += gradient

    @torch.no_grad()
    def project(self) -> None:
        """Subtract the means over the photos of each overlay, which so has their mean light; then bound all."""
        sums = self.coefficients.new_zeros(len(self._photos_of_groups), COEFFICIENTS)
        sums.index_add_(0, self._groups, self.coefficients)
        self.coefficients.sub_((sums / self._photos_of_groups)[self._groups])
        self.coefficients.clamp_(-MAX_COEFFICIENT, MAX_COEFFICIENT)

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint holds beside the coefficients."""
        return {"photos": self.photos}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take what a checkpoint holds; `shading_at_start` has compared it."""


def shading_at_start(
    setting: ShadingSetting,
    artifacts: Artifacts,
    names: list[str],
    cache: list[dict[str, Any]] | None,
    checkpoint: Path | None,
) -> Shading | None:
    """The shading of a training whose overlays are there.

    Args:
        setting: auto: where the photos say that the light changes, and as the checkpoint has it.
        artifacts: the model's overlays.
        names: the training photos' paths relative to the dataset.
        cache: the datamanager's undistorted photos in the same order; None where their exposure varies, too, so that
            they do not tell.
        checkpoint: that the training goes on from, which has the overlays; its coefficients are loaded later.

    Returns:
        None where all photos have the same light.

    Raises:
        InputError: the setting is another than the checkpoint's, or the checkpoint has the light of other photos.
    """
    if checkpoint is None:
        return _shading_of_photos(setting, artifacts, names, cache)
    state = load_pipeline_state(checkpoint)  # None: loading it will say what is wrong with it
    return None if state is None else _resumed_shading(setting, artifacts, names, state, "_model.shading.")


def _shading_of_photos(
    setting: ShadingSetting, artifacts: Artifacts, names: list[str], cache: list[dict[str, Any]] | None
) -> Shading | None:
    """The shading of a training that begins."""
    if setting == "off" or not artifacts.learned():
        return None
    views: dict[int, int] = {}
    found: list[Tensor] = []
    for group, overlay in enumerate(artifacts.learned()):
        own = [view for view in range(len(names)) if artifacts.group_of_view(view) == group]
        if not (overlay.evidence < 1).any():
            continue  # it hides nothing as it starts, so that a light would change nothing
        started = _light_at_start(setting, overlay, None if cache is None else [cache[view] for view in own], len(own))
        if started is not None:
            views |= dict.fromkeys(own, group)
            found.append(started)
    if not found:
        if setting == "affine":
            tell("The artifact hides nothing as the training starts: it has the same light in all photos.")
        return None
    if setting == "auto":
        tell(
            f"The light on the artifact changes: each of {counted(len(views), 'photo')} has its own. "
            "(--pipeline.model.shading off: the same in all.)"
        )
    return Shading(views, names, torch.cat(found))


def _light_at_start(
    setting: ShadingSetting, overlay: ScreenSpaceOverlay, photos: list[dict[str, Any]] | None, count: int
) -> Tensor | None:
    """Coefficients [count, 5] of an overlay's photos; None where they have the same light, as the setting goes."""
    if photos is None:
        return overlay.evidence.new_zeros(count, COEFFICIENTS) if setting == "affine" else None

    images, masks = [photo["image"] for photo in photos], [photo.get("mask") for photo in photos]
    basis, layers = basis_of(overlay), overlay.layers()
    if setting == "auto":
        some = changing_light(images, masks, basis, layers)
        if some is None:
            return None
        if len(some.coefficients) == count:
            return some.coefficients
    return artifact_light(images, masks, basis, layers).coefficients


def _resumed_shading(
    setting: ShadingSetting, artifacts: Artifacts, names: list[str], state: dict[str, Any], prefix: str
) -> Shading | None:
    """The shading of a training that goes on, with room for the coefficients in the pipeline's state."""
    saved = state.get(f"{prefix}coefficients")
    if setting != "auto" and (saved is None) != (setting == "off"):
        there, wanted = ("no", "off") if saved is None else ("a", "affine")
        raise InputError(
            f"the checkpoint has {there} shading of the artifact, this run's setting is another",
            f"resume with --pipeline.model.shading {wanted}, or leave the option out",
        )
    if saved is None or not artifacts.learned():
        return None
    there = state[f"{prefix}_extra_state"]["photos"]
    views_of: dict[str, list[int]] = {}
    for view, name in reversed(list(enumerate(names))):  # a photo may be listed twice
        views_of.setdefault(name, []).append(view)
    found = [views_of[name].pop() for name in there if views_of.get(name)]
    if missing := len(there) - len(found):
        raise InputError(
            f"the checkpoint has the shading of {counted(len(there), 'photo')}, "
            f"and {missing} of them {'is' if missing == 1 else 'are'} missing",
            "resume with the photos it was trained with",
        )
    bare = len(artifacts)  # of a photo without an overlay, whose light changes nothing
    groups = [artifacts.group_of_view(view) for view in found]
    views = {view: bare if group is None else group for view, group in zip(found, groups, strict=True)}
    return Shading(views, names, torch.zeros_like(saved, device=artifacts.learned()[0].evidence.device))
