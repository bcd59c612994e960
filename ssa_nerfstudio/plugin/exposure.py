"""Exposure: each photo has a gain and an offset per color channel, whose mean over all photos is the identity.

Gains and offsets are known only up to one that all photos share: the scene could be darker and every photo brighter.
So their mean is projected to the identity after every step; a soft penalty would let it drift.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.overlay.compositing import clip_straight_through

Place = Literal["scene", "photo"]
"""What exposure acts on. scene: the scene alone, because software drew the artifact into the finished photo; photo:
scene and artifact together, because the artifact is on or in front of the lens."""
BRIGHTEST = 4.0
"""Where the clean render of a training step is clipped, 1: white. A photo of short exposure shows what is beyond white
at the mean exposure, by up to two stops in the photo's own values."""


@dataclass(frozen=True)
class PhotoExposure:
    """The exposure of one photo."""

    gain: Tensor
    """g [3], above 0."""
    offset: Tensor
    """o [3]; 1: white."""

    def expose(self, image: Tensor) -> Tensor:
        """g C + o of an image C [..., 3], clipped to [0, 1] as a photo is, with the gradient of the unclipped."""
        return clip_straight_through(torch.addcmul(self.offset, image, self.gain))


class Exposure(nn.Module):
    """The exposures of all training photos. The identity stands for their mean, and for any other photo."""

    transforms: Parameter
    """[V, 2, 3]: logarithm of the gain, and offset, of each photo and channel. Their means over the photos are 0."""

    def __init__(self, photos: int) -> None:
        """Start from the identity.

        Args:
            photos: their number V.
        """
        super().__init__()
        self.transforms = Parameter(torch.zeros(photos, 2, 3))
        self.photos: list[str] = []
        """The photos' paths relative to the dataset."""
        self.place: Place = "photo"
        """What exposure acts on."""
        self.stated_place: Place | None = None
        """What the user says that it acts on; None: the photos decide."""

    def of_view(self, view: int) -> PhotoExposure:
        """The exposure of a training view."""
        log_gain, offset = self.transforms[view].unbind()
        return PhotoExposure(log_gain.exp(), offset)

    def gains(self) -> Tensor:
        """Of all photos [V, 3], without a gradient."""
        return self.transforms.detach()[:, 0].exp()

    @torch.no_grad()
    def project(self) -> None:
        """Subtract the means over the photos: the gains' geometric mean becomes 1, the offsets' mean 0."""
        self.transforms.sub_(self.transforms.mean(dim=0))

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint holds beside the transforms."""
        return {"photos": self.photos, "place": self.place}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take what a checkpoint holds."""
        self.photos, self.place = list(state["photos"]), state["place"]


def fit_checkpoint(exposure: Exposure | None, state: dict[str, Any], prefix: str) -> None:
    """Make room for the exposures of a checkpoint, or refuse one that this run cannot go on from.

    Args:
        exposure: the model's; of a model that is not being trained it takes any number of photos.
        state: the model's state dict.
        prefix: of the exposures' entries in it.

    Raises:
        InputError: one of the two has no exposures, or the checkpoint has those of other photos or in another place.
    """
    saved = state.get(f"{prefix}transforms")
    if (saved is None) != (exposure is None):
        there, setting = ("none", "off") if saved is None else ("some", "affine")
        raise InputError(
            f"the checkpoint has {there} of the photos' exposures, this run's setting is another",
            f"resume with --pipeline.model.exposure {setting}",
        )
    if exposure is None or saved is None:
        return
    if not exposure.training:
        exposure.transforms.data = exposure.transforms.data.new_zeros(saved.shape)
        return
    there = state[f"{prefix}_extra_state"]
    if exposure.stated_place not in (None, there["place"]):
        raise InputError(
            f"the checkpoint's exposure acts on the {there['place']}, this run's on the {exposure.stated_place}",
            "resume without --pipeline.model.exposure-place",
        )
    if there["photos"] != exposure.photos:
        raise InputError(
            f"the checkpoint has the exposures of {len(saved)} photos, and this run's {len(exposure.photos)} are not "
            "the same in the same order",
            "resume with the photos it was trained with",
        )
