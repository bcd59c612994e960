"""Compositing: the image that a camera records of a scene through an artifact.

Source: the paper, equation "composition". The matte's gradient over splats alone is ours (docs/method.md).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ssa_nerfstudio.overlay.resampling import straight_color


def composite(clean: Tensor, transmittance: Tensor, addition: Tensor) -> Tensor:
    """Composite an artifact over a render: I = T C + B (equation "composition" with T = 1 - A, B = A W).

    Args:
        clean: C [H, W, 3] in [0, 1].
        transmittance: T [H, W, 1] or [H, W, 3] in [0, 1].
        addition: B [H, W, 3], not negative.

    Returns:
        I [H, W, 3].
    """
    return transmittance * clean + addition


def composite_over_splats(
    clean: Tensor,
    accumulation: Tensor,
    background: Tensor,
    transmittance: Tensor,
    addition: Tensor,
    adds_light: bool = False,
) -> Tensor:
    """`composite` with a gradient that does not reward the matte for hiding background.

    Where no splat covers a pixel, the render shows the background color (in splatfacto a random one at every step).
    Plain compositing rewards an overlay for hiding it, and a sky without a single seed point ends up in the overlay.
    Here the matte's gradient is taken as if the overlay's own color were the background: hiding background gains
    nothing, sparsity removes the overlay there, and the scene has to fill the hole. A matte beside additive light
    shows no color of its own, so the background is black there.

    Args:
        clean: C [H, W, 3], the render with its background.
        accumulation: opacity of the splats [H, W, 1] in [0, 1].
        background: the color behind them [3].
        transmittance, addition: T [H, W, 1] and B [H, W, 3] in [0, 1].
        adds_light: B does not depend on the matte.

    Returns:
        [H, W, 3], the same values as `composite`.
    """
    with torch.no_grad():
        color = torch.zeros_like(background) if adds_light else straight_color(transmittance, addition)[0]
        over_color = clean + (1.0 - accumulation) * (color - background)
    return _OverSplats.apply(clean, transmittance, addition, over_color)  # pyright: ignore[reportReturnType]


def composite_logits(
    clean: Tensor, color_logits: Tensor, alpha_logits: Tensor, behind: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """`composite` of a matte and a color given as logits: I = (1 - A) C + A W.

    Value and gradient are by hand, in 13 kernel launches instead of autograd's 35: a step waits for its launches.

    Args:
        clean: C [H, W, 3], the render with its background.
        color_logits, alpha_logits: W~ [H, W, 3] and A~ [H, W, 1].
        behind: opacity of the splats [H, W, 1] and color of the background [3] for the matte's gradient of
            `composite_over_splats`; None for the gradient of plain compositing.

    Returns:
        I [H, W, 3].
    """
    return _CompositeLogits.apply(clean, color_logits, alpha_logits, *(behind or (None, None)))  # pyright: ignore[reportReturnType]


def clip_straight_through(image: Tensor) -> Tensor:
    """Clip I = T C + B to [0, 1], as a photo does, with the gradient of the identity.

    A prediction beyond white has to be pulled back; the gradient of a plain clamp is zero there.
    """
    return _ClipStraightThrough.apply(image)  # pyright: ignore[reportReturnType]


class _OverSplats(torch.autograd.Function):
    """T C + B with the gradient of T taken at another render."""

    @staticmethod
    def forward(ctx, clean: Tensor, transmittance: Tensor, addition: Tensor, over_color: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(transmittance, over_color)
        return composite(clean, transmittance, addition)

    @staticmethod
    @once_differentiable
    def backward(ctx, v: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        transmittance, over_color = ctx.saved_tensors
        return v * transmittance, (v * over_color).sum(dim=-1, keepdim=True), v, None


class _CompositeLogits(torch.autograd.Function):
    """(1 - A) C + A W as a function of the logits of A and W."""

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
        v_color = v * alpha
        v_alpha = ((color - hidden) * v).sum(dim=-1, keepdim=True)
        sigmoid = torch.ops.aten.sigmoid_backward
        return v - v_color, sigmoid(v_color, color), sigmoid(v_alpha, alpha), None, None


class _ClipStraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return image.clamp(0.0, 1.0)

    @staticmethod
    def backward(ctx, v: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return v
