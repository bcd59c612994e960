"""All optimizers of a training: their steps are counted in one kernel and taken together or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.nn import Parameter

from ssa_nerfstudio._system.cuda_graphs import graphs_are_usable
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdam
from ssa_nerfstudio.plugin.training.nonfinite import NonFiniteGuard
from ssa_nerfstudio.plugin.training.recorded_steps import RecordedSteps, take_steps


class JointOptimizers(Optimizers):
    """nerfstudio's optimizers with one verdict per step for all of them."""

    def __init__(
        self,
        config: dict[str, Any],
        param_groups: dict[str, list[Parameter]],
        guard: NonFiniteGuard | None,
    ) -> None:
        """As nerfstudio's.

        Args:
            config: by group, as in the trainer's configuration.
            param_groups: parameters by group.
            guard: None: every step is taken.
        """
        super().__init__(config, param_groups)
        self.guard = guard
        self._recorded = RecordedSteps()
        for optimizer in self.optimizers.values():
            if isinstance(optimizer, FusedAdam):
                # torch's schedulers warn unless `step` was called; `update` replaces it.
                optimizer._opt_called = True  # pyright: ignore[reportAttributeAccessIssue]

    def zero_grad_some(self, param_groups: list[str]) -> None:
        """Drop gradients, without the profiler marks of torch's `zero_grad` (a tenth of a millisecond in all)."""
        for name in param_groups:
            for group in self.optimizers[name].param_groups:
                for parameter in group["params"]:
                    parameter.grad = None

    def step_groups(self, groups: Sequence[str], loss: Tensor, grad_scaler: torch.amp.GradScaler) -> None:
        """Judge a step and let the groups take it.

        Args:
            groups: names of the groups that step now; the others accumulate gradients.
            loss: the step's loss [], unscaled.
            grad_scaler: nerfstudio's, enabled under mixed precision. With a guard it only unscales: the guard's verdict
                holds for all groups, the scaler's own would hold for one.
        """
        if self.guard is None and grad_scaler.is_enabled():
            super().optimizer_scaler_step_some(grad_scaler, list(groups))  # pyright: ignore[reportArgumentType]
            return
        optimizers = [self.optimizers[name] for name in groups if self._has_gradient(name)]
        if graphs_are_usable() and not grad_scaler.is_enabled() and self._can_be_recorded(groups):
            self._recorded(optimizers, loss, self.guard, self.optimizers)  # pyright: ignore[reportArgumentType]
            return
        if grad_scaler.is_enabled():
            for optimizer in optimizers:
                grad_scaler.unscale_(optimizer)
        verdict = None if self.guard is None else self.guard.judge(loss, self.optimizers)
        for name in groups:
            max_norm = self.config[name]["optimizer"].max_norm
            if max_norm is not None:
                # Not self.parameters, which keeps those from before the first refinement.
                groups_of = self.optimizers[name].param_groups
                torch.nn.utils.clip_grad_norm_([p for group in groups_of for p in group["params"]], max_norm)
        fused = [optimizer for optimizer in optimizers if isinstance(optimizer, FusedAdam)]
        take_steps(fused, verdict)
        for optimizer in optimizers:
            # Other optimizers cannot skip a step on the device, so the host waits for the verdict.
            if not isinstance(optimizer, FusedAdam) and (verdict is None or verdict.taken.item()):
                optimizer.step()

    def _can_be_recorded(self, groups: Sequence[str]) -> bool:
        """Whether a step of these groups is the same at all of its kind, and no gradient waits for a later one."""
        learned = [name for name in self.optimizers if self._has_gradient(name)]
        return all(
            name in groups and self.config[name]["optimizer"].max_norm is None for name in learned
        ) and RecordedSteps.fits([self.optimizers[name] for name in learned])

    def _has_gradient(self, name: str) -> bool:
        return any(p.grad is not None for group in self.optimizers[name].param_groups for p in group["params"])
