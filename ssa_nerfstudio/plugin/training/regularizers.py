"""Terms of the loss that are about the Gaussians alone."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter

from ssa_nerfstudio.plugin.settings import ModelSettings

SPREAD_EVERY = 10
"""Steps between two at which the shapes of the Gaussians are part of the loss, as in splatfacto."""


def regularizers(
    settings: ModelSettings, log_scales: Parameter, opacity_logits: Parameter, step: int, by_hand: bool = False
) -> dict[str, Tensor]:
    """The strategy's terms, and splatfacto's of needle-like Gaussians where the settings ask for it.

    Args:
        settings: the model's.
        log_scales: [N, 3], logarithms of world units.
        opacity_logits: [N, 1].
        step: of the training.
        by_hand: whether the gradients of terms that count at every step are added at once, and these have no history.
            Autograd's engine, which has a thread of its own, takes the host half a millisecond.
    """
    losses = {}
    if settings.strategy == "mcmc":
        losses |= (_mcmc_by_hand if by_hand else _mcmc)(settings, log_scales, opacity_logits)
    if settings.use_scale_regularization and step % SPREAD_EVERY == 0:
        spread = log_scales.amax(dim=-1) - log_scales.amin(dim=-1)
        excess = torch.exp(spread).clamp_min(settings.max_gauss_ratio) - settings.max_gauss_ratio
        losses["scale_reg"] = 0.1 * excess.mean()
    return losses


def _mcmc(settings: ModelSettings, log_scales: Tensor, opacity_logits: Tensor) -> dict[str, Tensor]:
    """Those of 3DGS as MCMC (arXiv 2404.09591)."""
    return {
        "opacity_reg": settings.mcmc_opacity_regularizer * torch.sigmoid(opacity_logits).mean(),
        "mcmc_scale_reg": settings.mcmc_scale_regularizer * torch.exp(log_scales).mean(),
    }


@torch.no_grad()
def _mcmc_by_hand(settings: ModelSettings, log_scales: Parameter, opacity_logits: Parameter) -> dict[str, Tensor]:
    """`_mcmc` without history; adds its gradients, rounded as autograd rounds them."""
    opacities, scales = torch.sigmoid(opacity_logits), torch.exp(log_scales)
    of_opacity, of_scale = settings.mcmc_opacity_regularizer, settings.mcmc_scale_regularizer
    losses = {"opacity_reg": of_opacity * opacities.mean(), "mcmc_scale_reg": of_scale * scales.mean()}
    slope = float(np.float32(of_opacity) / np.float32(opacities.numel()))
    _add_gradient(opacity_logits, (1 - opacities).mul_(slope).mul_(opacities))
    _add_gradient(log_scales, scales.mul_(float(np.float32(of_scale) / np.float32(scales.numel()))))
    return losses


def _add_gradient(parameter: Parameter, gradient: Tensor) -> None:
    if parameter.grad is None:
        parameter.grad = gradient
    else:
        parameter.grad.add_(gradient)  # in place: recorded steps of the optimizers read it there
