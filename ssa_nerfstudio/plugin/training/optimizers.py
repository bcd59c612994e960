"""All optimizers of a training at once: their steps counted in one kernel, and taken all together or not at all."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.nn import Parameter

from ssa_nerfstudio.plugin.training.fused_adam import FusedAdam, count_steps
from ssa_nerfstudio.plugin.training.nonfinite import StepGuard


class JointOptimizers(Optimizers):
    """nerfstudio's optimizers, with a guard that judges every step or none."""

    def __init__(
        self,
        config: dict[str, Any],
        param_groups: dict[str, list[Parameter]],
        guard: StepGuard | None,
    ) -> None:
        """As nerfstudio's.

        Args:
            config: by group, as in the trainer's configuration.
            param_groups: parameters by group.
            guard: None: every step is taken.
        """
        super().__init__(config, param_groups)
        self.guard = guard
        self._counted: list[list[Tensor]] = []
        """The numbers of steps that went up at every judged step since the last look."""
        self._quick: set[str] = set()
        """Groups of which nothing is asked but to step."""
        for name, optimizer in self.optimizers.items():
            if guard is not None:
                guard.watch(optimizer)
            if isinstance(optimizer, FusedAdam) and config[name]["optimizer"].max_norm is None:
                self._quick.add(name)
                # What torch's schedulers ask for before their first step; `update` goes round what would say it.
                optimizer._opt_called = True  # pyright: ignore[reportAttributeAccessIssue]

    def zero_grad_some(self, param_groups: list[str]) -> None:
        """Forget gradients; without what torch does around that for its profiler, a tenth of a millisecond in all."""
        for name in param_groups:
            for group in self.optimizers[name].param_groups:
                for parameter in group["params"]:
                    parameter.grad = None

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Judge the step, and step the groups."""
        optimizers = {name: self.optimizers[name] for name in param_groups}
        refused = None if self.guard is None else self.guard.judge(self.optimizers)
        others = [name for name in param_groups if grad_scaler.is_enabled() or name not in self._quick]
        quick = [o for name, o in optimizers.items() if name not in others and isinstance(o, FusedAdam)]
        with torch.no_grad():
            counters = [counter for optimizer in quick for counter in optimizer.counters()]
            count_steps(counters)
            for optimizer in quick:
                optimizer.update(refused)
        if refused is not None:
            self._counted.append(counters)
        if others:
            super().optimizer_scaler_step_some(grad_scaler, others)

    def look(self, step: int) -> None:
        """Let the guard look, and take back the count of steps that it skipped.

        Until here, at most `READ_EVERY` steps, Adam has taken them for steps. It then corrects both moments as it would
        later on, so that its steps are longer: by a few percent after a few skipped ones, at most twice as long after
        dozens at the beginning of a training. To count what the device decides would cost a kernel a step.
        """
        if self.guard is None:
            return
        counted, self._counted = self._counted, []
        for at in self.guard.look(step):
            count_steps(counted[at], -1)
