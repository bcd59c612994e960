"""The picture that a photo shows of a render and the artifact in front of it.

Source: the paper, equation "composition"; that the matte sees splats only is ours (docs/method.md).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ssa_nerfstudio.overlay.resampling import straight_color


def composite(clean: Tensor, transmittance: Tensor, addition: Tensor) -> Tensor:
    """Put an artifact in front of a render: I = T C + B (equation "composition" with T = 1 - A, B = A W).

    Args:
        clean: [H, W, 3] in [0, 1].
        transmittance: [H, W, 1] or [H, W, 3] in [0, 1].
        addition: [H, W, 3], not negative.
    """
    return transmittance * clean + addition


def composite_over_splats(
    clean: Tensor, accumulation: Tensor, background: Tensor, transmittance: Tensor, addition: Tensor
) -> Tensor:
    """`composite`, with a gradient of the matte that sees splats only: an overlay gains nothing by hiding background.

    Where no splat covers a pixel, the render shows the background color (in splatfacto a random one at every step).
    Plain compositing rewards an overlay for hiding it, and a sky without a single seed point ends up in the overlay.
    Here the matte is judged as if the overlay's own color stood behind the splats: there, nothing is gained, sparsity
    takes the overlay back, and the scene has to fill the hole.

    Args:
        clean: [H, W, 3], the render with its background.
        accumulation: [H, W, 1], opacity of the splats.
        background: [3], the color behind them.
        transmittance, addition: [H, W, 1] and [H, W, 3] in [0, 1].

    Returns:
        [H, W, 3], the same values as `composite`.
    """
    with torch.no_grad():
        color, _ = straight_color(transmittance, addition)
        over_color = clean + (1.0 - accumulation) * (color - background)
    return _OverSplats.apply(clean, transmittance, addition, over_color)  # pyright: ignore[reportReturnType]


def paint(
    clean: Tensor, color_logits: Tensor, alpha_logits: Tensor, behind: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """`composite` of an artifact that hides, straight from its logits: I = (1 - A) C + A W.

    A step waits for launches of kernels; value and gradient are by hand, in 13 of them instead of 35.

    Args:
        clean: [H, W, 3], the render with its background.
        color_logits, alpha_logits: W~ [H, W, 3] and A~ [H, W, 1].
        behind: opacity of the splats [H, W, 1] and color of the background [3]: the gradient of the matte is that of
            `composite_over_splats`; None: that of the picture.
    """
    return _Painted.apply(clean, color_logits, alpha_logits, *(behind or (None, None)))  # pyright: ignore[reportReturnType]


def clipped(picture: Tensor) -> Tensor:
    """What a photo records of I = T C + B: [0, 1]. Its gradient is that of the identity."""
    return _Clipped.apply(picture)  # pyright: ignore[reportReturnType]


class _OverSplats(torch.autograd.Function):
    """T C + B, whose gradient of T is taken at another render. By hand: a step waits for the host, not for the GPU."""

    @staticmethod
    def forward(ctx, clean: Tensor, transmittance: Tensor, addition: Tensor, over_color: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(transmittance, over_color)
        return composite(clean, transmittance, addition)

    @staticmethod
    @once_differentiable
    def backward(ctx, v: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        transmittance, over_color = ctx.saved_tensors
        return v * transmittance, (v * over_color).sum(dim=-1, keepdim=True), v, None


class _Painted(torch.autograd.Function):
    """(1 - A) C + A W of the logits of A and W."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx,
        clean: Tensor,
        color_logits: Tensor,
        alpha_logits: Tensor,
        accumulation: Tensor | None,
        background: Tensor | None,
    ) -> Tensor:
        color, alpha = torch.sigmoid(color_logits), torch.sigmoid(alpha_logits)
        ctx.save_for_backward(clean, color, alpha, accumulation, background)
        return torch.lerp(clean, color, alpha)

    @staticmethod
    @once_differentiable
    def backward(ctx, v: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        clean, color, alpha, accumulation, background = ctx.saved_tensors
        hidden = clean
        if accumulation is not None:
            hidden = torch.addcmul(clean, 1.0 - accumulation, color - background)
        painted = v * alpha
        by_alpha = ((color - hidden) * v).sum(dim=-1, keepdim=True)
        sigmoid = torch.ops.aten.sigmoid_backward
        return v - painted, sigmoid(painted, color), sigmoid(by_alpha, alpha), None, None


class _Clipped(torch.autograd.Function):
    """Clip to [0, 1]; the gradient passes. A prediction beyond white is to be brought back, not left alone."""

    @staticmethod
    def forward(ctx, picture: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return picture.clamp(0.0, 1.0)

    @staticmethod
    def backward(ctx, v: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return v
