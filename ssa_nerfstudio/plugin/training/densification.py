"""How the Gaussians multiply: adaptive density control (ADC) and MCMC, gsplat's strategies behind the same four calls.

Both answer `initialize_state(scene_scale)`, `step_pre_backward(...)` and `step_post_backward(...)` with the arguments
that `SplatfactoModel` passes, and have `absgrad`, so that the model does not know which one it holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy, MCMCStrategy
from torch import Tensor

from ssa_nerfstudio.plugin.training.langevin_noise import perturb
from ssa_nerfstudio.plugin.training.nonfinite import bury_broken


@dataclass
class AdaptiveDensityControl(DefaultStrategy):
    """gsplat's DefaultStrategy (3DGS, Kerbl et al. 2023), with statistics that need no host synchronization.

    gsplat 1.4.0 resets opacities at step 0 too (`step % reset_every == 0`). Here that reset is left out: it exists to
    expose floaters, of which there are none before the first step, and the original implementation has none either.
    """

    guarded: bool = True
    """Leave skipped steps out of the statistics, remove Gaussians that are not finite, and never remove the last."""

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
        """The same sums as gsplat's, over all Gaussians with zeros where invisible, instead of over a compacted list.

        Compaction (`torch.where`) waits for the device at every training step.
        """
        means2d: Tensor = info[self.key_for_gradient]
        gradients = means2d.absgrad if self.absgrad else means2d.grad  # pyright: ignore[reportAttributeAccessIssue]
        assert gradients is not None
        if state["grad2d"] is None:
            state["grad2d"] = gradients.new_zeros(gradients.shape[1])
            state["count"] = gradients.new_zeros(gradients.shape[1])
        if self.refine_scale2d_stop_iter > 0 and state["radii"] is None:
            state["radii"] = gradients.new_zeros(gradients.shape[1])
        least = 0
        if self.guarded and info.get("skipped") is not None:
            # The float 1 of a skipped step is 0x3f800000 as an integer: no radius is larger, nothing counts as visible.
            least = info["skipped"].view(torch.int32)
        width, height = info["width"], info["height"]
        half = 0.5 * info["n_cameras"] * width / info.get("magnification", 1.0)
        for gradient, radii in zip(gradients, info["radii"], strict=True):  # a camera's [N, 2], [N]
            visible = radii > least
            # With respect to coordinates that run over [-1, 1] across the image.
            norms = torch.hypot(gradient[:, 0], gradient[:, 1] * (height / width))
            state["grad2d"].add_(torch.where(visible, norms, 0.0), alpha=half)
            state["count"] += visible
            if self.refine_scale2d_stop_iter > 0:
                sizes = torch.where(visible, radii, 0) / float(max(width, height))
                torch.maximum(state["radii"], sizes, out=state["radii"])

    @torch.no_grad()
    def _prune_gs(self, params: Any, optimizers: dict[str, torch.optim.Optimizer], state: dict[str, Any], step: int):
        """Remove what is transparent, too large or not finite, unless nothing would be left to go on with."""
        if self.guarded:
            bury_broken(params)
            sizes = torch.exp(params["scales"]).amax(dim=-1)
            stays = torch.sigmoid(params["opacities"].flatten()) >= self.prune_opa
            if step > self.reset_every:
                stays &= sizes <= self.prune_scale3d * state["scene_scale"]
            if not stays.any():
                return 0
        return super()._prune_gs(params, optimizers, state, step)


@dataclass
class MarkovChainMonteCarlo(MCMCStrategy):
    """gsplat's MCMCStrategy (Kheradmand et al. 2024): dead Gaussians move to living ones, up to a fixed number.

    Its schedule stands here again because of the last line of a step: gsplat's noise is fifteen launches.
    """

    absgrad: bool = False
    """MCMC reads no gradients of the centers; a field because the render call asks for it."""
    guarded: bool = True
    """Relocate Gaussians that are not finite, and go on where nobody is alive; skipped steps perturb nothing."""

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
            self._add_new_gs(params, optimizers, binoms)
            torch.cuda.empty_cache()
        lr = optimizers["means"].param_groups[0]["lr"]
        perturb(params, lr * self.noise_lr, info.get("skipped") if self.guarded else None)

    @torch.no_grad()
    def _relocate_gs(self, params: Any, optimizers: dict[str, torch.optim.Optimizer], binoms: Tensor) -> int:
        """Move the dead to the living. Where nobody lives, wake everybody: gsplat would draw from nothing and fail.

        A Gaussian of less than 1/255 is never drawn and gets no gradient, so a dead scene would stay dead.
        """
        if self.guarded:
            broken = bury_broken(params)
            opacities = params["opacities"]
            if not (torch.sigmoid(opacities) > self.min_opacity).any():
                awake = math.log(2 * self.min_opacity / (1 - 2 * self.min_opacity))
                opacities.masked_fill_(~broken[:, None], awake)
                for key, moment in optimizers["opacities"].state[opacities].items():
                    if key != "step":
                        moment.zero_()
                return 0
        return super()._relocate_gs(params, optimizers, binoms)
