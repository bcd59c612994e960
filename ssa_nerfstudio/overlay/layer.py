"""The overlay as a torch module: learned (`ScreenSpaceOverlay`), or known (`OracleOverlay`).

Source: the paper, section "Modeling screen-space artifacts"; additive light is ours.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.overlay.compositing import composite, composite_logits, composite_over_splats
from ssa_nerfstudio.overlay.resampling import letterbox, premultiply, reduced_size, smallest_matte, to_training_scale

CONSTANT_INITIALIZATION = (0.5, 0.1)
"""Initial color and matte of the paper's ablation "constant start"."""
INITIAL_MATTE_RANGE = (0.01, 0.99)
"""The initial matte is clamped to this before the logit: exp(-sigma / s) is exactly 1 where sigma is 0."""
INITIAL_COLOR_RANGE = (1 / 510, 1 - 1 / 510)
"""The initial color is clamped to this before the logit: half a gray level from black and white."""
MATTE_LOGIT_RANGE = (-12.0, math.log(0.999 / 0.001))
"""Range of the learned matte's logits: 6e-6 to 0.999. Beyond it the sigmoid is flat, a pixel never recovers, and the
scene behind an opaque pixel loses all gradient. 0.999 is 255 in 8 bits, and gsplat's maximal alpha of one Gaussian. An
oracle overlay has no such range."""
COLOR_LOGIT_RANGE = (-12.0, 12.0)
"""Range of the learned color's logits: 6e-6 to 1 - 6e-6, for the same reason."""
HIDDEN_BELOW = 0.1
"""Transmittance below which photos say next to nothing of the scene: what they say is in proportion to its square. A
backdrop is behind such pixels, and their matte may hide background."""
UNSEEN_BELOW = 1 / 255
"""Transmittance below which a white scene makes less than a gray level of a photo."""
OPTIONAL_BUFFERS = ("falloff", "reliable", "noise")
"""Buffers of an overlay that have one pixel of value 1 where nothing is known of them, as in earlier checkpoints."""


class ScreenSpaceOverlay(nn.Module):
    """A learnable RGBA image shared by all views of one camera: W = sigmoid(W~), A = sigmoid(A~), one per pixel.

    T = 1 - A and B = A W (paper). For an artifact that adds light, B = W independent of A. Behind a lens with a falloff
    F, which is not learned, T = F (1 - A) and B = F A W: the prior is about what is in front of the scene.
    """

    frame: Tensor
    """[4] int64: height, width, resolution, adds_light. On loading, a checkpoint gives the overlay's size by it, before
    any photo is opened."""
    evidence: Tensor
    """r [h, w, 1] in [0, 1], small where the artifact was found: weight of the sparsity loss; below HIDDEN_BELOW the
    scene is known to be hidden (`composite`)."""
    falloff: Tensor
    """F [h, w, 1] in (0, 1] of a lens or a photo editor (`evidence.falloff`); [1, 1, 1] of value 1 for none."""
    reliable: Tensor
    """[h, w, 1] in [0, 1]: 0 where the artifact changes (`evidence.changing_area`), and the scene gets no gradient;
    [1, 1, 1] of value 1 for nowhere."""
    noise: Tensor
    """[1, 1, 1] in (0, 1]: deviation of the photos from scene and artifact (`LayerEstimate.noise`); 1 where unknown."""

    def __init__(self, height: int, width: int, resolution: int = 1, adds_light: bool = False) -> None:
        """Create an overlay with constant color and matte.

        Args:
            height, width: of the camera's undistorted frame, pixels.
            resolution: 1, 2 or 4: the overlay holds one pixel for a block of this side.
            adds_light: B is learned independently of A.
        """
        super().__init__()
        size = reduced_size(height, width, resolution)
        color, alpha = CONSTANT_INITIALIZATION
        self.color_logits = nn.Parameter(torch.full((*size, 3), color).logit())
        self.alpha_logits = nn.Parameter(torch.full((*size, 1), alpha).logit())
        self.register_buffer("frame", torch.tensor([height, width, resolution, int(adds_light)]))
        self.register_buffer("evidence", torch.ones(*size, 1))
        self.register_buffer("falloff", torch.ones(1, 1, 1))
        self.register_buffer("reliable", torch.ones(1, 1, 1))
        self.register_buffer("noise", torch.ones(1, 1, 1))
        self.height, self.width, self.resolution, self.adds_light = height, width, resolution, adds_light

    @torch.no_grad()
    def initialize(self, color: Tensor, alpha: Tensor, evidence: Tensor) -> None:
        """Set the parameters and buffers; color and matte are clamped so that their logits are finite.

        Args:
            color: W, straight color or additive light, [h, w, 3] in [0, 1].
            alpha: A, [h, w, 1] in [0, 1].
            evidence: r, [h, w, 1] in [0, 1], small where the artifact was found.
        """
        self.color_logits.copy_(color.clamp(*INITIAL_COLOR_RANGE).logit())
        self.alpha_logits.copy_(alpha.clamp(*INITIAL_MATTE_RANGE).logit())
        self.evidence.copy_(evidence)

    @torch.no_grad()
    def clamp_logits(self) -> None:
        """Clamp the parameters to MATTE_LOGIT_RANGE and COLOR_LOGIT_RANGE, where a gradient can still move them."""
        self.alpha_logits.clamp_(*MATTE_LOGIT_RANGE)
        self.color_logits.clamp_(*COLOR_LOGIT_RANGE)

    @torch.no_grad()
    def clearest(self, share: float) -> tuple[Tensor, Tensor]:
        """T [] and B [3] on the mean over the pixels that hide least, a share of the frame in (0, 1]."""
        transmittance, addition = self.layers()
        opacity = smallest_matte(transmittance, addition).flatten()
        pixels = opacity.topk(max(1, round(share * len(opacity))), largest=False, sorted=False).indices
        return transmittance.flatten()[pixels].mean(), addition.reshape(-1, 3)[pixels].mean(dim=0)

    @torch.no_grad()
    def clear(self, transmittance: Tensor, addition: Tensor) -> None:
        """Leave a film out that the scene shows from now on: C becomes T C + B of its T [] and B [3].

        The composite stays the same, T / T_film (T_film C + B_film) + B - T / T_film B_film, but for pixels clearer
        than the film, which become clear.
        """
        hidden_by, shown = self.matte(), self.color()
        through = self.falloff * (1 - hidden_by) / transmittance
        falloff = (self.falloff / transmittance).clamp_max(1.0) if self.falloff.numel() > 1 else self.falloff
        own = self.falloff * (shown if self.adds_light else hidden_by * shown) - through * addition
        through, own = (through / falloff).clamp_max(1.0), (own / falloff).clamp(0.0, 1.0)
        if self.adds_light:
            matte, color = 1 - through, own
        else:
            matte = smallest_matte(through, own)
            color = (own + 1e-6 * shown) / (matte + 1e-6)  # a clear pixel keeps its color
        self.color_logits.copy_(color.logit())
        self.alpha_logits.copy_(matte.logit())
        self.falloff.copy_(falloff)
        self.clamp_logits()

    def color(self) -> Tensor:
        """W: straight color, or additive light, [h, w, 3] in (0, 1)."""
        return torch.sigmoid(self.color_logits)

    def matte(self) -> Tensor:
        """A [h, w, 1] in (0, 1)."""
        return torch.sigmoid(self.alpha_logits)

    def opacity(self) -> Tensor:
        """The argument of the sparsity loss [h, w, 1] in (0, 1): A, or for additive light the maximum of A and B."""
        if self.adds_light:
            return torch.sigmoid(torch.maximum(self.alpha_logits, self.color_logits.amax(dim=-1, keepdim=True)))
        return self.matte()

    def composite(
        self,
        clean: Tensor,
        reduction: int = 1,
        behind: tuple[Tensor, Tensor] | None = None,
        light: Tensor | None = None,
    ) -> Tensor:
        """Composite the overlay over a render: I = T C + B.

        Args:
            clean: C [H // reduction, W // reduction, 3], the render with its background.
            reduction: 1, 2, 4 or 8: factor by which training images are reduced.
            behind: opacity of the splats [H // reduction, W // reduction, 1] and color of the background [3], for the
                matte's gradient of `composite_over_splats`, but for pixels of which the initialization says that they
                hide the scene (`evidence` below HIDDEN_BELOW): hiding background is what they do. While they transmit
                less than UNSEEN_BELOW, too, the scene gets no gradient from them. None for plain compositing.
            light: a factor of B, of the render's shape; None for 1.

        Returns:
            I, of the render's shape; not clipped.
        """
        if self.reliable.numel() > 1 and clean.requires_grad:
            clean = torch.lerp(clean.detach(), clean, self._at_training_scale(self.reliable, reduction))
        if behind is not None:
            known = self._at_training_scale(self.evidence, reduction) < HIDDEN_BELOW
            behind = behind[0].masked_fill(known, 1.0), behind[1]
            if clean.requires_grad:
                # Adam's steps do not shrink with the gradient: splats that are seen only through 0.1 % would learn at
                # full rate what the panel's color lacks.
                with torch.no_grad():
                    hides = known & (self._at_training_scale(self.matte(), reduction) > 1 - UNSEEN_BELOW)
                clean = torch.where(hides, clean.detach(), clean)
        if self.resolution == reduction == 1 and not self.adds_light and light is None:
            image = composite_logits(clean, self.color_logits, self.alpha_logits, behind)
        else:
            transmittance, addition = self.before_falloff(reduction)
            addition = addition if light is None else light * addition
            if behind is None:
                image = composite(clean, transmittance, addition)
            else:
                image = composite_over_splats(clean, *behind, transmittance, addition, self.adds_light)
        return image if self.falloff.numel() == 1 else image * self.falloff_at(reduction)

    def layers(self, reduction: int = 1) -> tuple[Tensor, Tensor]:
        """Resample the overlay to training images, averaged premultiplied.

        Args:
            reduction: 1, 2, 4 or 8: factor by which training images are reduced.

        Returns:
            Transmittance T [H // reduction, W // reduction, 1] and addition B [H // reduction, W // reduction, 3].
        """
        transmittance, addition = self.before_falloff(reduction)
        if self.falloff.numel() == 1:
            return transmittance, addition
        falloff = self.falloff_at(reduction)
        return falloff * transmittance, falloff * addition

    def before_falloff(self, reduction: int = 1) -> tuple[Tensor, Tensor]:
        """As `layers`, without the falloff: what is in front of the scene alone."""
        if self.adds_light:
            transmittance, addition = 1.0 - self.matte(), self.color()
        else:
            transmittance, addition = premultiply(self.color(), self.matte())
        if self.resolution == reduction == 1:
            return transmittance, addition
        pair = self._at_training_scale(torch.cat([transmittance, addition], dim=-1), reduction)
        return pair[..., :1], pair[..., 1:]

    def falloff_at(self, reduction: int = 1) -> Tensor:
        """The falloff F [H // reduction, W // reduction, 1], in (0, 1]."""
        if self.falloff.numel() == 1:
            return self.falloff.expand(self.height // reduction, self.width // reduction, 1)
        return self._at_training_scale(self.falloff, reduction)

    def _at_training_scale(self, layer: Tensor, reduction: int) -> Tensor:
        if self.resolution == reduction == 1:
            return layer
        return to_training_scale(layer, self.resolution, reduction, self.height, self.width)


class OracleOverlay(nn.Module):
    """The true artifact, known and not learned: I = clip(T C + B), T per channel. The reference of a benchmark."""

    frame: Tensor
    """[4] int64: height, width, 1, 0; as that of `ScreenSpaceOverlay`."""
    transmittance: Tensor
    addition: Tensor

    def __init__(self, transmittance: Tensor, addition: Tensor) -> None:
        """Store the layers.

        Args:
            transmittance: T [H, W, 3] of the undistorted frame, in [0, 1].
            addition: B [H, W, 3].

        Raises:
            InputError: a shape other than [H, W, 3], values that are not finite, or T outside [0, 1].
        """
        super().__init__()
        if transmittance.dim() != 3 or transmittance.shape[2] != 3 or transmittance.shape != addition.shape:
            shapes = tuple(transmittance.shape), tuple(addition.shape)
            raise InputError(f"T and B must both be [H, W, 3], they are {shapes[0]} and {shapes[1]}")
        if not (torch.isfinite(transmittance).all() and torch.isfinite(addition).all()):
            raise InputError("T or B holds values that are not finite")
        if transmittance.min() < 0 or transmittance.max() > 1:
            raise InputError("T must lie in [0, 1]")
        self.register_buffer("transmittance", transmittance.float())
        self.register_buffer("addition", addition.float())
        self.height, self.width = transmittance.shape[:2]
        self.register_buffer("frame", torch.tensor([self.height, self.width, 1, 0]))

    def composite(self, clean: Tensor, reduction: int = 1, behind: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """As `ScreenSpaceOverlay.composite`; without a learned matte, `behind` makes no difference."""
        return composite(clean, *self.layers(reduction))

    def layers(self, reduction: int = 1) -> tuple[Tensor, Tensor]:
        """T and B [H // reduction, W // reduction, 3], averaged."""
        return (
            to_training_scale(self.transmittance, 1, reduction, self.height, self.width),
            to_training_scale(self.addition, 1, reduction, self.height, self.width),
        )


def letterboxed_layers(overlay: ScreenSpaceOverlay | OracleOverlay, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Fit an overlay's layers into a frame of any size and aspect: scaled without stretching, centered.

    Returns:
        Transmittance [height, width, 1 or 3], 1 around the overlay, and addition [height, width, 3], 0 around it.
    """
    transmittance, addition = overlay.layers()
    return letterbox(transmittance, height, width, 1.0), letterbox(addition, height, width, 0.0)
