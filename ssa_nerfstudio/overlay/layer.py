"""The artifact as a picture in front of every view: what is learned of it, its start, its layers.

Source: the paper, section "Modeling screen-space artifacts"; light that hides nothing is ours.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ssa_nerfstudio.overlay.compositing import composite, composite_over_splats, paint
from ssa_nerfstudio.overlay.resampling import letterbox, reduced_size, stack_premultiplied, to_training_scale

CONSTANT_START = (0.5, 0.1)
"""Color and matte of the paper's ablation "constant start"."""
MATTE_START_RANGE = (0.01, 0.99)
"""The starting matte is clamped to this before the logit: exp(-sigma / s) is exactly 1 where sigma is 0."""
MATTE_LOGIT_RANGE = (-12.0, math.log(0.999 / 0.001))
"""While it learns, the matte stays between 6e-6 and 0.999: beyond, the sigmoid is flat and a pixel never comes back,
and the scene behind an opaque pixel would lose all gradient. 0.999 is 255 in a file of 8 bits, and gsplat's largest
alpha of one Gaussian. A given artifact has no such range."""
COLOR_LOGIT_RANGE = (-12.0, 12.0)
"""While it learns, the color stays between 6e-6 and 1 - 6e-6, for the same reason."""
COLOR_START_RANGE = (1 / 510, 1 - 1 / 510)
"""The starting color is clamped to this before the logit: half a gray level from black and white."""


class ScreenSpaceOverlay(nn.Module):
    """A learnable RGBA image shared by all views of one camera: W = sigmoid(W~), A = sigmoid(A~), one per pixel.

    T = 1 - A and B = A W (paper); or, for an artifact that adds light, B = W, whatever A is.
    """

    frame: Tensor
    evidence: Tensor
    near: Tensor

    def __init__(self, height: int, width: int, resolution: int = 1, adds_light: bool = False) -> None:
        """Make an overlay for a frame, with the paper's constant start.

        Args:
            height, width: the camera's frame in pixels (undistorted).
            resolution: 1, 2 or 4: the overlay holds one pixel for a block of this side.
            adds_light: what it adds does not depend on what it hides.
        """
        super().__init__()
        size = reduced_size(height, width, resolution)
        color, alpha = CONSTANT_START
        self.color_logits = nn.Parameter(torch.full((*size, 3), color).logit())
        self.alpha_logits = nn.Parameter(torch.full((*size, 1), alpha).logit())
        # Lets a checkpoint say how large its overlay is, before any photo has been opened.
        self.register_buffer("frame", torch.tensor([height, width, resolution, int(adds_light)]))
        self.register_buffer("evidence", torch.ones(*size, 1))
        self.register_buffer("near", torch.ones(*size, 1))
        self.height, self.width, self.resolution, self.adds_light = height, width, resolution, adds_light
        self._held: list[tuple[Tensor, Tensor]] = []

    @torch.no_grad()
    def initialize(self, color: Tensor, alpha: Tensor, evidence: Tensor, near: Tensor) -> None:
        """Start from given layers of the overlay's own size; both are clamped so that their logits are finite.

        Args:
            color: W, straight color or the light that is added, [h, w, 3] in [0, 1].
            alpha: A, [h, w, 1] in [0, 1].
            evidence: r, [h, w, 1] in [0, 1], weight of the sparsity term.
            near: [h, w, 1] bool, pixels that learn from the first step (`hold_far_pixels`).
        """
        self.color_logits.copy_(color.clamp(*COLOR_START_RANGE).logit())
        self.alpha_logits.copy_(alpha.clamp(*MATTE_START_RANGE).logit())
        self.evidence.copy_(evidence)
        self.near.copy_(near)

    @torch.no_grad()
    def wait_for_the_scene(self, waiting: bool) -> None:
        """Hold what is far from static edges as it is, from the first step for which this is said to the last.

        Early in a training an overlay explains anything constant (the sky ahead of a walk) sooner than Gaussians can.
        What the scene has learned by itself when the wait is over, the overlay gains nothing by taking.
        """
        if not waiting:
            self._held = []
        elif not self._held:
            self._held = [(p.clone(), (self.near > 0).expand_as(p)) for p in self.parameters()]

    @torch.no_grad()
    def take_back(self) -> None:
        """After a step: undo it where the overlay waits; where it does not, nothing is held.

        Rather than to let no gradient through: Adam would not know its size when the wait is over, and start with steps
        six times too large.
        """
        for parameter, (held, near) in zip(self.parameters(), self._held, strict=False):
            torch.where(near, parameter, held, out=parameter)

    @torch.no_grad()
    def keep_in_range(self) -> None:
        """Clamp the parameters to where a gradient can still move them (`MATTE_LOGIT_RANGE`, `COLOR_LOGIT_RANGE`)."""
        self.alpha_logits.clamp_(*MATTE_LOGIT_RANGE)
        self.color_logits.clamp_(*COLOR_LOGIT_RANGE)

    def color(self) -> Tensor:
        """W: straight color, or the light that is added, [h, w, 3] in (0, 1)."""
        return torch.sigmoid(self.color_logits)

    def matte(self) -> Tensor:
        """A: opacity [h, w, 1] in (0, 1)."""
        return torch.sigmoid(self.alpha_logits)

    def opacity(self) -> Tensor:
        """What sparsity weighs, [h, w, 1]: A; of an artifact that adds light the largest of A and B."""
        if self.adds_light:
            return torch.sigmoid(torch.maximum(self.alpha_logits, self.color_logits.amax(dim=-1, keepdim=True)))
        return self.matte()

    def in_front_of(self, clean: Tensor, reduction: int = 1, behind: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """What a photo shows of a render: I = T C + B.

        Args:
            clean: [H // reduction, W // reduction, 3], the render with its background.
            reduction: 1, 2 or 4: training images are reduced by this.
            behind: opacity of the splats [..., 1] and color of the background [3], which the matte then gains nothing
                by hiding (`composite_over_splats`); None: plain compositing.
        """
        if self.resolution == reduction == 1 and not self.adds_light:
            return paint(clean, self.color_logits, self.alpha_logits, behind)
        layers = self.layers(reduction)
        return composite(clean, *layers) if behind is None else composite_over_splats(clean, *behind, *layers)

    def layers(self, reduction: int = 1) -> tuple[Tensor, Tensor]:
        """Transmittance [H // reduction, W // reduction, 1] and added light [..., 3], averaged premultiplied.

        Args:
            reduction: 1, 2 or 4: training images are reduced by this.
        """
        if self.adds_light:
            transmittance, addition = 1.0 - self.matte(), self.color()
        else:
            transmittance, addition = stack_premultiplied(self.color(), self.matte())
        if self.resolution == reduction == 1:
            return transmittance, addition
        pair = torch.cat([transmittance, addition], dim=-1)
        pair = to_training_scale(pair, self.resolution, reduction, self.height, self.width)
        return pair[..., :1], pair[..., 1:]


class GivenOverlay(nn.Module):
    """The true artifact, known and not learned: I = clip(T C + B), T per channel. The reference of every benchmark."""

    frame: Tensor
    transmittance: Tensor
    addition: Tensor

    def __init__(self, transmittance: Tensor, addition: Tensor) -> None:
        """Take T and B [H, W, 3] of the undistorted frame.

        Raises:
            ValueError: for shapes other than [H, W, 3], values that are not finite, or T outside [0, 1].
        """
        super().__init__()
        if transmittance.dim() != 3 or transmittance.shape[2] != 3 or transmittance.shape != addition.shape:
            shapes = tuple(transmittance.shape), tuple(addition.shape)
            raise ValueError(f"T and B must both be [H, W, 3], they are {shapes[0]} and {shapes[1]}")
        if not (torch.isfinite(transmittance).all() and torch.isfinite(addition).all()):
            raise ValueError("T or B holds values that are not finite")
        if transmittance.min() < 0 or transmittance.max() > 1:
            raise ValueError("T must lie in [0, 1]")
        self.register_buffer("transmittance", transmittance.float())
        self.register_buffer("addition", addition.float())
        self.height, self.width = transmittance.shape[:2]
        self.register_buffer("frame", torch.tensor([self.height, self.width, 1, 0]))

    def in_front_of(self, clean: Tensor, reduction: int = 1, behind: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """As `ScreenSpaceOverlay.in_front_of`; there is no matte that could gain anything."""
        return composite(clean, *self.layers(reduction))

    def layers(self, reduction: int = 1) -> tuple[Tensor, Tensor]:
        """T and B [H // reduction, W // reduction, 3], averaged."""
        return (
            to_training_scale(self.transmittance, 1, reduction, self.height, self.width),
            to_training_scale(self.addition, 1, reduction, self.height, self.width),
        )


def fitted(overlay: ScreenSpaceOverlay | GivenOverlay, height: int, width: int) -> tuple[Tensor, Tensor]:
    """An overlay's layers in a frame of any size and aspect: scaled, centered, never stretched; clear around it."""
    transmittance, addition = overlay.layers()
    return letterbox(transmittance, height, width, 1.0), letterbox(addition, height, width, 0.0)
