"""All optimisers of a training at once: their steps counted in one kernel, and taken all together or not at all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.nn import Parameter

from ssa_nerfstudio.errors import warn
from ssa_nerfstudio.plugin.fused_adam import FusedAdam, count_steps, thaw
from ssa_nerfstudio.plugin.guards import StepGuard


class JointOptimizers(Optimizers):
    """nerfstudio's optimisers, with a guard that judges every step or none."""

    def __init__(
        self,
        config: dict[str, Any],
        param_groups: dict[str, list[Parameter]],
        guard: StepGuard | None,
        losses: Callable[[], Sequence[Tensor]],
    ) -> None:
        """As nerfstudio's.

        Args:
            config: by group, as in the trainer's configuration.
            param_groups: parameters by group.
            guard: None: every step is taken.
            losses: the terms of the current step's loss, for the guard.
        """
        super().__init__(config, param_groups)
        self.guard, self._losses = guard, losses
        if guard is not None:
            for optimizer in self.optimizers.values():
                guard.watch(optimizer)

    def zero_grad_some(self, param_groups: list[str]) -> None:
        """Forget gradients; without what torch does around that for its profiler, a tenth of a millisecond in all."""
        for name in param_groups:
            for group in self.optimizers[name].param_groups:
                for parameter in group["params"]:
                    parameter.grad = None

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Judge the step, count it, and step the groups."""
        if self.guard is not None:
            self.guard.judge(self._losses(), {name: self.optimizers[name] for name in param_groups})
        fused = [self.optimizers[name] for name in param_groups]
        fused = [optimizer for optimizer in fused if isinstance(optimizer, FusedAdam)]
        # Skipped ones too, until the host's next look: to leave them out costs a kernel at every step.
        count_steps([counter for optimizer in fused for counter in optimizer.counters()], 1)
        for optimizer in fused:
            optimizer.counted = True
        super().optimizer_scaler_step_some(grad_scaler, param_groups)

    def look(self, step: int) -> None:
        """Let the host see what the guard noted, and mend what a step that was taken can have broken.

        Raises:
            TrainingFailed: the guard gives up.
        """
        if self.guard is None:
            return
        skipped = self.guard.look(step)
        fused = [optimizer for optimizer in self.optimizers.values() if isinstance(optimizer, FusedAdam)]
        if skipped:
            count_steps([counter for optimizer in fused for counter in optimizer.counters()], -skipped)
        thawed = thaw(self.optimizers)
        if thawed:
            warn(f"up to step {step} gradients of {', '.join(thawed)} were too large for their squares; they go on")
