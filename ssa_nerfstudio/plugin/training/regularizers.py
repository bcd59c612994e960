"""Terms of the loss that are about the Gaussians alone."""

from __future__ import annotations

import torch
from torch import Tensor

from ssa_nerfstudio.plugin.settings import ModelSettings

SPREAD_EVERY = 10
"""Steps between two at which the shapes of the Gaussians are part of the loss, as in splatfacto."""


def regularizers(settings: ModelSettings, log_scales: Tensor, opacity_logits: Tensor, step: int) -> dict[str, Tensor]:
    """The strategy's terms, and splatfacto's of needle-like Gaussians where the settings ask for it.

    Args:
        settings: the model's.
        log_scales: [N, 3], logarithms of world units.
        opacity_logits: [N, 1].
        step: of the training.
    """
    losses = {}
    if settings.strategy == "mcmc":
        losses["opacity_reg"] = settings.mcmc_opacity_regularizer * torch.sigmoid(opacity_logits).mean()
        losses["mcmc_scale_reg"] = settings.mcmc_scale_regularizer * torch.exp(log_scales).mean()
    if settings.use_scale_regularization and step % SPREAD_EVERY == 0:
        spread = log_scales.amax(dim=-1) - log_scales.amin(dim=-1)
        excess = torch.exp(spread).clamp_min(settings.max_gauss_ratio) - settings.max_gauss_ratio
        losses["scale_reg"] = 0.1 * excess.mean()
    return losses
