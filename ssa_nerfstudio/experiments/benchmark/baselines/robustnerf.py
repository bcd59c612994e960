"""RobustNeRF (Sabour et al., CVPR 2023) on splats, as SpotLessSplats implements it: photometric outliers are masked.

A pixel is an inlier where its residual is below the 0.7 quantile of recent residuals, or where more than half of its
3 x 3 neighborhood is. The loss is L1 of the inliers, without SSIM; while the scene is young, outliers take part, too.
Source: "SpotLessSplats" (Sabour et al., TOG 2025), its code (Apache-2.0), read and written anew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ssa_nerfstudio.experiments.benchmark.baselines.baseline import Baseline, BaselineModel, Count, Share
from ssa_nerfstudio.plugin.model import SSASplatfactoModelConfig

BINS = 10_000
"""Of the histogram of residuals over [0, 1]."""
DECAY = 0.95
"""Of the histogram, at every step."""
TRANSPARENT = -20.0
"""Logit of an opacity that every refinement prunes."""
SPECULAR_LIMIT = 0.001
"""What the coefficients above degree 0 are clamped to at the reset."""


class ResidualHistogram:
    """Decaying histogram of residuals, whose quantiles are thresholds; without waiting for the device."""

    def __init__(self) -> None:
        self._counts: Tensor | None = None

    def add(self, residuals: Tensor) -> None:
        """Add residuals in [0, 1] of one view, any shape."""
        counts = torch.histc(residuals.detach(), BINS, 0.0, 1.0)
        self._counts = counts if self._counts is None else DECAY * self._counts + counts

    def quantile(self, share: float) -> Tensor | float:
        """The residual below which a share of them lies, a scalar; 1 before the first view."""
        if self._counts is None:
            return 1.0
        mass = self._counts.cumsum(0)
        return torch.searchsorted(mass, share * mass[-1:]).squeeze() / BINS


def residual(shown: Tensor, target: Tensor) -> Tensor:
    """Mean over channels of |shown - target|, both [H, W, 3]: [H, W, 1]; no gradient."""
    return (shown.detach() - target).abs().mean(dim=-1, keepdim=True)


def inliers(residuals: Tensor, threshold: Tensor | float) -> Tensor:
    """1 where a residual [H, W, 1] is below the threshold or more than half of its 3 x 3 neighborhood is, else 0."""
    below = (residuals < threshold).to(residuals.dtype)
    # Pixels beyond the border count as outliers, as in the original.
    share = F.avg_pool2d(below.permute(2, 0, 1), 3, stride=1, padding=1).permute(1, 2, 0)
    return torch.maximum(below, (share > 0.5).to(below.dtype))


@dataclass
class RobustConfig(SSASplatfactoModelConfig):
    """Configuration of `RobustModel`; hyperparameters are those of the SpotLessSplats code."""

    _target: type = field(default_factory=lambda: RobustModel)
    own_steps: ClassVar[tuple[str, ...]] = ("mask_warmup", "specular_reset_at")
    inlier_quantile: Share = 0.7
    """Share of the residuals that are inliers by themselves."""
    mask_warmup: Count = 500
    """Steps in which the share of all pixels that take part, inliers or not, falls by a factor of e (1.5 / 3e-3)."""
    specular_reset_at: int = 8002
    """Step at which view-dependent color, which explains distractors first, is clamped to SPECULAR_LIMIT; 0: never."""
    prune_unused: bool = False
    """Utilization-based pruning of SpotLessSplats, under ADC: remove Gaussians that hardly any photo pulls."""
    unused_threshold: float = 1e-14
    """Summed squared gradient of the projected center, over a pass over the photos, below which one is removed."""


class RobustModel(BaselineModel):
    """splatfacto whose loss leaves out photometric outliers."""

    config: RobustConfig

    def populate_modules(self) -> None:
        """splatfacto's, and an empty histogram."""
        super().populate_modules()
        self.residuals = ResidualHistogram()

    def loss_mask(self, shown: Tensor, target: Tensor, batch: dict) -> Tensor | None:
        """The dataset's mask times a sample of Bernoulli(a + (1 - a) m): m the inliers, a = exp(-step / warmup)."""
        mask = super().loss_mask(shown, target, batch)
        if not self.training:
            return mask
        inlier = self.inlier_weights(residual(shown, target), batch)
        warmup = math.exp(-self.step / self.config.mask_warmup)
        drawn = torch.bernoulli((warmup + (1.0 - warmup) * inlier).clamp(0.0, 1.0))
        return drawn if mask is None else drawn * mask

    def inlier_weights(self, residuals: Tensor, batch: dict) -> Tensor:
        """Probability [H, W, 1] that a pixel is an inlier; the histogram grows as long as the scene does."""
        found = inliers(residuals, self.residuals.quantile(self.config.inlier_quantile))
        if self.step < self.config.stop_split_at:
            self.residuals.add(residuals)
        return found

    def step_post_backward(self, step: int) -> None:
        """Densify as splatfacto does, without what is unused, then reset view-dependent color once."""
        if self.config.prune_unused and self.config.strategy != "mcmc":
            self._mark_unused(step)
        super().step_post_backward(step)
        if step and step == self.config.specular_reset_at:
            self._reset_specular()

    @torch.no_grad()
    def _mark_unused(self, step: int) -> None:
        """Make unused Gaussians transparent before a refinement, which then removes them."""
        # gsplat's refinement duplicates, splits and removes whatever tensors its state holds, as it does the Gaussians.
        state, gradient = self.strategy_state, self.info["means2d"].grad
        if state.get("utilization") is None:
            state["utilization"], self._utilized_steps = torch.zeros_like(self.opacities[:, 0]), 0
        state["utilization"] += gradient.reshape(-1, 2).square().sum(dim=1)
        self._utilized_steps += 1
        due = self.config.warmup_length < step < self.config.stop_split_at and step % self.config.refine_every == 0
        if due and self._utilized_steps >= self.num_train_data:  # every photo had its say
            unused = state["utilization"] < self.config.unused_threshold
            self.gauss_params["opacities"][unused] = TRANSPARENT
            state["utilization"].zero_()
            self._utilized_steps = 0

    @torch.no_grad()
    def _reset_specular(self) -> None:
        coefficients = self.gauss_params["features_rest"]
        coefficients.clamp_(max=SPECULAR_LIMIT)
        for name, moment in self.optimizers["features_rest"].state[coefficients].items():
            if name != "step":
                moment.zero_()


BASELINE = Baseline(
    RobustConfig,
    # No SSIM, and no opacity reset: 3000 refinements are 300,000 steps.
    settings={"overlay": "off", "ssim_lambda": 0.0, "reset_alpha_every": 3000},
)
