"""Adam in one kernel a parameter group, with little Python around it, and steps that the device can refuse."""

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
    """`torch.optim.Adam(fused=True)`, whose state it keeps to the letter.

    A training of splats has seven optimizers of one or two parameters, and is bound by the host: what torch does around
    the kernel (sorting by device and type, a dictionary of found_inf a call, undoing the step count of a refused step
    with one more kernel) costs several times the kernel.
    """

    refused: Tensor | None = None
    """One number on the device: where it is 1, a step changes nothing. None: every step is taken."""

    def __init__(self, params: Any, **settings: Any) -> None:
        super().__init__(params, fused=True, **settings)

    def counters(self) -> list[Tensor]:
        """The numbers of steps, on the device, of the parameters that have a gradient."""
        return [self._of(p)["step"] for group in self.param_groups for p in group["params"] if p.grad is not None]

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Take a step with the gradients that there are, and count it.

        Args:
            closure: not supported; as in torch for gradient scaling.
        """
        scale: Tensor | None = getattr(self, "grad_scale", None)
        overflow: Tensor | None = getattr(self, "found_inf", None)  # both are a GradScaler's
        refused = self.refused
        if overflow is not None:
            refused = overflow if refused is None else torch.maximum(overflow, refused)
        count_steps(self.counters(), 1 if refused is None else 1 - refused)
        self.update(refused, scale)

    def update(self, refused: Tensor | None, scale: Tensor | None = None) -> None:
        """Take a step that is counted already: `step` without torch's hooks and profiler marks. Under `no_grad`.

        Args:
            refused: one number; where it is 1, nothing changes.
            scale: one number by which the gradients are too large.
        """
        for group in self.param_groups:
            parameters = [p for p in group["params"] if p.grad is not None]
            if not parameters:
                continue
            states = [self._of(p) for p in parameters]
            torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
                parameters,
                [p.grad for p in parameters],
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                [state["step"] for state in states],
                lr=group["lr"],
                beta1=group["betas"][0],
                beta2=group["betas"][1],
                weight_decay=group["weight_decay"],
                eps=group["eps"],
                amsgrad=False,
                maximize=False,
                grad_scale=scale,
                found_inf=refused,
            )

    def _of(self, parameter: Tensor) -> dict[str, Tensor]:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        return state


def count_steps(counters: list[Tensor], more: float | Tensor = 1) -> None:
    """Add to numbers of steps; in one kernel, and on the device where `more` [] is there.

    A list of it then, because torch would read a tensor without dimensions from the device to use it as a number.
    """
    if counters:
        each = [more.reshape(())] * len(counters) if isinstance(more, Tensor) else more
        torch._foreach_add_(counters, each)  # pyright: ignore[reportPrivateImportUsage]
