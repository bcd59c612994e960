"""Adam in one kernel per parameter group, with little Python around it, and steps that the device can skip."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from torch import Tensor


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Configuration of `FusedAdam`. eps is 1e-15: gradients here are means over pixels, about 1 / (H W), and torch's
    1e-8 would freeze whatever a single pixel drives."""

    _target: type = field(default_factory=lambda: FusedAdam)
    eps: float = 1e-15
    """Added to the root of the second moment."""


class FusedAdam(torch.optim.Adam):
    """`torch.optim.Adam(fused=True)` with the same state.

    A training of splats has seven optimizers of one or two parameters and is bound by the host: what torch does around
    the kernel (sorting by device and type, one more kernel to undo the count of a skipped step) costs several times the
    kernel. Uses the private `torch._fused_adam_` and `torch._foreach_add_`; `compat.versions` checks torch's version.
    """

    def __init__(self, params: Any, **settings: Any) -> None:
        super().__init__(params, fused=True, **settings)

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Count and take a step.

        Args:
            closure: not supported; as in torch for gradient scaling.
        """
        scale: Tensor | None = getattr(self, "grad_scale", None)
        overflow: Tensor | None = getattr(self, "found_inf", None)  # both are set by a GradScaler
        count_steps(self.counters(), 1 if overflow is None else 1 - overflow)
        self.update(overflow, scale)

    def counters(self) -> list[Tensor]:
        """Numbers of steps, scalars on the device, of the parameters that have a gradient."""
        return [self._state_of(p)["step"] for group in self.param_groups for p in group["params"] if p.grad is not None]

    def update(self, skipped: Tensor | None, scale: Tensor | None = None, rate: Tensor | None = None) -> None:
        """Take a step that is counted already: `step` without torch's hooks and profiler marks. Under `no_grad`.

        Args:
            skipped: scalar; where it is 1, nothing changes.
            scale: scalar by which the gradients are too large.
            rate: scalar on the device, in place of the groups' learning rates.
        """
        for group in self.param_groups:
            parameters = [p for p in group["params"] if p.grad is not None]
            if not parameters:
                continue
            states = [self._state_of(p) for p in parameters]
            torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
                parameters,
                [p.grad for p in parameters],
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                [state["step"] for state in states],
                lr=group["lr"] if rate is None else rate,
                beta1=group["betas"][0],
                beta2=group["betas"][1],
                weight_decay=group["weight_decay"],
                eps=group["eps"],
                amsgrad=False,
                maximize=False,
                grad_scale=scale,
                found_inf=skipped,
            )

    def addresses(self) -> list[int]:
        """Where everything is that a step reads or changes."""
        found = []
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    found += [p.numel(), p.data_ptr(), p.grad.data_ptr()]
                    found += [each.data_ptr() for each in self._state_of(p).values()]
        return found

    def _state_of(self, parameter: Tensor) -> dict[str, Tensor]:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        return state


def count_steps(counters: list[Tensor], increment: float | Tensor = 1) -> None:
    """Add to numbers of steps, in one kernel and without reading the device.

    Args:
        counters: scalars.
        increment: a number, or a scalar on the device.
    """
    if counters:
        # A list, because torch would read a tensor without dimensions from the device to use it as a number.
        each = [increment.reshape(())] * len(counters) if isinstance(increment, Tensor) else increment
        torch._foreach_add_(counters, each)  # pyright: ignore[reportPrivateImportUsage]
