"""One artifact on the sphere: while training, the overlays of a panorama's faces stay equal where these overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ssa_nerfstudio.cameras.panorama import Face, owned_by_neighbors
from ssa_nerfstudio.overlay.layer import COLOR_LOGIT_RANGE, MATTE_LOGIT_RANGE, ScreenSpaceOverlay

EVERY = 10
"""Steps from one `share` to the next; in so few, pixels that are to be equal hardly part."""


@dataclass(frozen=True)
class _Copies:
    """Pixels of an overlay that repeat another one's."""

    owner: int
    pixels: Tensor
    """[P], row by row."""
    sources: Tensor
    """The owner's four pixels around each, [P, 4]."""
    weights: Tensor
    """Of those, bilinear, [P, 4, 1]."""


class SharedSphere:
    """Overlays of faces, of which each direction has one pixel that is learned; others that see it repeat it.

    The owner of a direction is the face in whose middle it is nearest (`owned_by_neighbors`). Nothing is averaged: a
    mean taken again and again would blur both.
    """

    def __init__(self, faces: Sequence[Face], overlays: Sequence[ScreenSpaceOverlay]) -> None:
        """Find which pixels repeat which.

        Args:
            faces: all of one size.
            overlays: one for each face, all of one resolution and on one device.
        """
        self._overlays = overlays
        device = overlays[0].alpha_logits.device
        self._copies: list[list[_Copies]] = []
        for face, overlay in zip(faces, overlays, strict=True):
            owned = owned_by_neighbors(face, [each for each in faces if each != face], overlay.resolution)
            side = overlay.alpha_logits.shape[0]
            self._copies.append(
                [
                    _Copies(faces.index(owner), torch.from_numpy(pixels).to(device), *_around(positions, side, device))
                    for owner, pixels, positions in owned
                ]
            )

    @torch.no_grad()
    def share(self) -> None:
        """Let every pixel that another face owns repeat it: the matte, and the color or light that is added."""
        found = [[self._repeated(copy) for copy in copies] for copies in self._copies]
        for overlay, copies, values_of in zip(self._overlays, self._copies, found, strict=True):
            for copy, (alpha, addition) in zip(copies, values_of, strict=True):
                color = addition if overlay.adds_light else addition / alpha.clamp_min(1e-9)
                for logits, values, limits in (
                    (overlay.alpha_logits, alpha, MATTE_LOGIT_RANGE),
                    (overlay.color_logits, color, COLOR_LOGIT_RANGE),
                ):
                    flat = logits.view(-1, logits.shape[-1])
                    flat[copy.pixels] = values.clamp(0, 1).logit().clamp(*limits)

    def _repeated(self, copy: _Copies) -> tuple[Tensor, Tensor]:
        """A [P, 1] and B [P, 3], in front of the lens, where an owner is to be repeated."""
        owner = self._overlays[copy.owner]
        matte, color = (
            torch.sigmoid(logits.view(-1, logits.shape[-1])[copy.sources])
            for logits in (owner.alpha_logits, owner.color_logits)
        )
        addition = color if owner.adds_light else matte * color
        return (matte * copy.weights).sum(dim=1), (addition * copy.weights).sum(dim=1)


def _around(positions: np.ndarray, side: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The four pixels around positions [P, 2] in a square, and their bilinear weights."""
    inside = torch.from_numpy(positions).to(device).float() - 0.5
    first = inside.floor().clamp(0, max(0, side - 2))
    share = (inside - first).clamp(0, 1)
    column, row = first.long().unbind(dim=-1)
    right, below = (column + 1).clamp_max(side - 1), (row + 1).clamp_max(side - 1)
    sources = torch.stack([row * side + column, row * side + right, below * side + column, below * side + right], dim=1)
    x, y = share.unbind(dim=-1)
    weights = torch.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x], dim=1)
    return sources, weights[..., None]
