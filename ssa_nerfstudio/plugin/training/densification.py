"""Densification: gsplat's adaptive density control (ADC) and MCMC behind one interface.

Both have `initialize_state(scene_scale)`, `step_pre_backward(...)` and `step_post_backward(...)` with the arguments
that `SplatfactoModel` passes, and `absgrad`, so that the model need not know which one it holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy, MCMCStrategy
from torch import Tensor
from torch.nn import ParameterDict

from ssa_nerfstudio.plugin.compat.gsplat_repairs import repair_mcmc
from ssa_nerfstudio.plugin.settings import ModelSettings
from ssa_nerfstudio.plugin.training.gradient_statistics import GradientStatistics
from ssa_nerfstudio.plugin.training.langevin_noise import perturb
from ssa_nerfstudio.plugin.training.nonfinite import mark_for_removal

PIXELS_PER_GAUSSIAN = 150
"""Pixels of the training photos for which MCMC has a Gaussian: 7.6 color values for each of its 59 parameters. Half
and twice the number of Gaussians change PSNR by -0.3 and +0.2 dB on the mean of four captures (docs/cost.md)."""
MAX_GAUSSIANS = 1_000_000
"""MCMC's largest number of Gaussians unless the settings state one: nerfstudio's and gsplat's."""


def gaussian_budget(pixels: int, seeds: int) -> int:
    """MCMC's largest number of Gaussians for photos of so many pixels altogether: none of the seeds is taken away."""
    return max(seeds, min(MAX_GAUSSIANS, round(pixels / PIXELS_PER_GAUSSIAN)))


def make_strategy(
    settings: ModelSettings, defaults: dict[str, Any], params: ParameterDict
) -> AdaptiveDensityControl | MarkovChainMonteCarlo:
    """Make the strategy that the settings name; MCMC also sets the opacities and scales that it starts from.

    Args:
        settings: the model's; "auto", which only a trainer settles, is ADC.
        defaults: fields of splatfacto's own `DefaultStrategy`, which ADC uses.
        params: of the Gaussians, changed in place under MCMC.
    """
    if settings.strategy != "mcmc":
        strategy = AdaptiveDensityControl(**{**defaults, "verbose": False, "guarded": settings.guards})
        if settings.pause_after_reset is not None:
            strategy.pause_refine_after_reset = settings.pause_after_reset
        return strategy
    with torch.no_grad():
        params["opacities"].fill_(torch.tensor(settings.mcmc_opacity_start).logit())
        params["scales"].add_(torch.tensor(settings.mcmc_scale_start).log())
    return MarkovChainMonteCarlo(
        cap_max=settings.cap_max or MAX_GAUSSIANS,
        refine_start_iter=settings.warmup_length,
        refine_stop_iter=settings.mcmc_stop_at,
        refine_every=settings.refine_every,
        guarded=settings.guards,
    )


@dataclass
class AdaptiveDensityControl(DefaultStrategy):
    """gsplat's DefaultStrategy (3DGS, Kerbl et al. 2023) with statistics that need no host synchronization.

    gsplat 1.4.0 also resets opacities at step 0 (`step % reset_every == 0`). This one does not: a reset exposes
    floaters, and there are none before the first step.
    """

    guarded: bool = True
    """Remove Gaussians that are not finite, and never remove the last ones."""

    def step_post_backward(
        self,
        params: Any,
        optimizers: dict[str, torch.optim.Optimizer],
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Collect gradients; grow, prune and reset where the schedule says so."""
        if step == 0:
            self._update_state(params, state, info, packed)
            return
        super().step_post_backward(params, optimizers, state, step, info, packed)

    def _update_state(self, params: Any, state: dict[str, Any], info: dict[str, Any], packed: bool = False) -> None:
        """Add a step that was taken to gsplat's sums."""
        means2d: Tensor = info[self.key_for_gradient]
        gradients = means2d.absgrad if self.absgrad else means2d.grad  # pyright: ignore[reportAttributeAccessIssue]
        assert gradients is not None
        if state["grad2d"] is None:
            state["grad2d"] = gradients.new_zeros(gradients.shape[1])
            state["count"] = gradients.new_zeros(gradients.shape[1])
        if self.refine_scale2d_stop_iter > 0 and state["radii"] is None:
            state["radii"] = gradients.new_zeros(gradients.shape[1])
        statistics = GradientStatistics(
            state["grad2d"], state["count"], state["radii"] if self.refine_scale2d_stop_iter > 0 else None
        )
        size, taken = (info["width"], info["height"], info["n_cameras"]), info.get("taken")
        for gradient, radii in zip(gradients, info["radii"], strict=True):  # a camera's [N, 2], [N]
            statistics.add(gradient, radii, *size, taken)

    @torch.no_grad()
    def _prune_gs(self, params: Any, optimizers: dict[str, torch.optim.Optimizer], state: dict[str, Any], step: int):
        """Remove what is transparent, too large or not finite, unless no Gaussian would be left."""
        if self.guarded:
            mark_for_removal(params)
            sizes = torch.exp(params["scales"]).amax(dim=-1)
            stays = torch.sigmoid(params["opacities"].flatten()) >= self.prune_opa
            if step > self.reset_every:
                stays &= sizes <= self.prune_scale3d * state["scene_scale"]
            if not stays.any():
                return 0
        return super()._prune_gs(params, optimizers, state, step)


@dataclass
class MarkovChainMonteCarlo(MCMCStrategy):
    """gsplat's MCMCStrategy (Kheradmand et al. 2024): dead Gaussians are relocated to living ones, with a fixed cap.

    The schedule is repeated here because of the noise, which is fifteen launches in gsplat and two here.
    """

    absgrad: bool = False
    """MCMC reads no gradients of the centers; a field because the render call asks for it."""
    guarded: bool = True
    """Relocate Gaussians that are not finite, and revive a scene in which all are dead."""

    def __post_init__(self) -> None:
        repair_mcmc()

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """State of the strategy; the scene's scale plays no part in it."""
        return super().initialize_state()

    def step_post_backward(
        self,
        params: Any,
        optimizers: dict[str, torch.optim.Optimizer],
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Relocate, add and perturb; the noise follows the current learning rate of the means."""
        due = step % self.refine_every == 0
        if due and self.refine_start_iter < step < self.refine_stop_iter:
            binoms = state["binoms"] = state["binoms"].to(params["means"].device)
            self._relocate_gs(params, optimizers, binoms)
            if self._add_new_gs(params, optimizers, binoms):
                torch.cuda.empty_cache()  # of blocks of the former sizes; to allocate the same again takes time
        lr = optimizers["means"].param_groups[0]["lr"]
        perturb(params, lr * self.noise_lr, info.get("taken"))

    @torch.no_grad()
    def _relocate_gs(self, params: Any, optimizers: dict[str, torch.optim.Optimizer], binoms: Tensor) -> int:
        """Relocate dead Gaussians. Where all are dead, raise every opacity: gsplat would sample from nothing and fail.

        A Gaussian below an opacity of 1/255 is never drawn and gets no gradient, so a dead scene would stay dead.
        """
        if self.guarded:
            broken = mark_for_removal(params)
            opacities = params["opacities"]
            if not (torch.sigmoid(opacities) > self.min_opacity).any():
                awake = math.log(2 * self.min_opacity / (1 - 2 * self.min_opacity))
                opacities.masked_fill_(~broken[:, None], awake)
                for key, moment in optimizers["opacities"].state[opacities].items():
                    if key != "step":
                        moment.zero_()
                return 0
        return super()._relocate_gs(params, optimizers, binoms)
