"""What keeps a training step finite. Every decision is taken on the device; the host looks every 100 steps.

None of this is part of the method: it works the same with the overlay off, and `guards: False` in the model's
configuration takes all of it away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from ssa_nerfstudio.errors import give_up, warn
from ssa_nerfstudio.rasterization.constants import NEAR_PLANE

READ_EVERY = 100
"""Steps between two looks of the host at what the device noted."""
SCALE_RANGE = (1e-8, 1e4)
"""Sizes of Gaussians in world units. The smaller is a thousandth of a pixel at the near plane for a focal length of
1000 pixels; with the larger, the determinant of a projected covariance still fits into float32."""
START_DISTANCE = NEAR_PLANE
"""A start point nearer to a camera than this (world units) is inside it: that camera can never draw it."""

LONELY_SIZE = 0.01
"""Size (world units) of start points that all lie in one place."""


class StepGuard:
    """Decides on the device whether a step may be taken: only where the loss and every gradient's norm are finite.

    The norm and not the largest value, because a gradient whose square overflows turns Adam's second moment into
    infinity, after which that element never moves again.
    """

    def __init__(self, limit: int) -> None:
        """Make a guard.

        Args:
            limit: so many skipped steps in a row end the training, at the host's next look.
        """
        self.limit = limit
        self.skipped: Tensor | None = None
        """1 where the current step is skipped, else 0: one float tensor on the device; None before the first step."""
        self._watched: list[tuple[str, Tensor]] = []
        self._norms: Tensor
        self._noted = 0
        self._row, self._row_began, self._culprits = 0, 0, ""

    def judge(self, loss: Tensor, optimizers: dict[str, torch.optim.Optimizer]) -> None:
        """Decide about the step whose gradients the optimisers' parameters hold; no waiting for the device."""
        found = list(_parameters(optimizers))
        if self.skipped is None:
            self.skipped = loss.new_zeros((), dtype=torch.float32)
        if len(self._watched) != len(found):
            self._norms, self._noted = self.skipped.new_zeros(READ_EVERY, 1 + len(found)), 0
        self._watched = found
        values = [loss.detach(), *(self.skipped.new_zeros(()) if p.grad is None else p.grad.detach() for _, p in found)]
        each = torch._foreach_norm(values)  # pyright: ignore[reportPrivateImportUsage]
        norms = torch.stack([norm.float() for norm in each])
        self._norms[self._noted % READ_EVERY] = norms
        self._noted += 1
        self.skipped.copy_(~(norms.sum() < math.inf))

    def before_step(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        """Hook that makes an optimiser skip: fused ones are told on the device, for others the host has to ask."""
        if self.skipped is None:
            return
        if getattr(optimizer, "_step_supports_amp_scaling", False):
            scalers = getattr(optimizer, "found_inf", None)  # a GradScaler has found something of its own
            if scalers is None or scalers is self.skipped:
                optimizer.found_inf = self.skipped  # pyright: ignore[reportAttributeAccessIssue]
            else:
                optimizer.found_inf = torch.maximum(self.skipped, scalers)  # pyright: ignore[reportAttributeAccessIssue]
        elif self.skipped.item():
            for group in optimizer.param_groups:
                for parameter in group["params"]:
                    parameter.grad = None

    def look(self, step: int) -> int:
        """Read what was noted since the last look: the number of skipped steps.

        Raises:
            TrainingFailed: where `limit` steps in a row, up to any of them, were skipped.
        """
        rows = self._norms[: self._noted].tolist() if self._noted else []
        self._noted = 0
        skipped = 0
        for at, row in enumerate(rows, start=step + 1 - len(rows)):
            broken = [k for k, norm in enumerate(row) if not math.isfinite(norm)]
            if not broken:
                self._row = 0
                continue
            skipped += 1
            if self._row == 0:
                self._row_began, self._culprits = at, self._described(broken)
            self._row += 1
            if self._row >= self.limit:
                raise give_up(
                    f"training stopped at step {step}: {self.limit} steps in a row, from step {self._row_began} on, "
                    f"were skipped because {self._culprits} not finite; resume from an earlier checkpoint (--load-dir) "
                    "with lower learning rates"
                )
        if skipped:
            warn(f"{skipped} of the {len(rows)} steps up to {step} were skipped: {self._culprits} not finite")
        return skipped

    def _described(self, broken: list[int]) -> str:
        """What was not finite: "the loss", "the gradient of scales", and the parameters that are so themselves."""
        names = [name for name, _ in self._watched]
        values = [name for name, parameter in self._watched if not torch.isfinite(parameter).all()]
        if values:
            return f"{', '.join(values)} (the values themselves) and what follows from them were"
        gradients = [names[k - 1] for k in broken if k]
        parts = ["the loss"] * (broken[0] == 0)
        if len(gradients) == len(names):
            parts.append("every gradient")
        elif gradients:
            parts.append(f"the gradient of {', '.join(gradients)}")
        return f"{' and '.join(parts)} {'was' if len(parts) == 1 else 'were'}"


class GuardedOptimizers(Optimizers):
    """nerfstudio's optimisers, which take a step all together or not at all."""

    def __init__(
        self,
        config: dict[str, Any],
        param_groups: dict[str, list[Parameter]],
        guard: StepGuard,
        loss: Callable[[], Tensor],
    ) -> None:
        super().__init__(config, param_groups)
        self.guard, self._loss = guard, loss
        for optimizer in self.optimizers.values():
            optimizer.register_step_pre_hook(guard.before_step)

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Judge the step, then step the groups."""
        self.guard.judge(self._loss(), {name: self.optimizers[name] for name in param_groups})
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


def _parameters(optimizers: dict[str, torch.optim.Optimizer]) -> Iterator[tuple[str, Tensor]]:
    """Every parameter with its name. Not from a list of old: densification puts new ones into the optimisers."""
    for name, optimizer in optimizers.items():
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        for number, parameter in enumerate(parameters):
            yield (name if len(parameters) == 1 else f"{name}[{number}]"), parameter


@torch.no_grad()
def keep_scales_in_range(log_scales: Tensor) -> None:
    """Clamp log scales [N, 3] to `SCALE_RANGE`, in place."""
    log_scales.clamp_(math.log(SCALE_RANGE[0]), math.log(SCALE_RANGE[1]))


@torch.no_grad()
def bury_broken(params: ParameterDict | dict[str, Parameter]) -> Tensor:
    """Give Gaussians with a value that is not finite an opacity of nothing, so that the densification takes them away.

    Returns:
        [N], True where a Gaussian is broken.
    """
    broken = torch.stack([~torch.isfinite(p).flatten(1).all(dim=1) for p in params.values()]).any(dim=0)
    params["opacities"].masked_fill_(broken[:, None], -15.0)
    return broken


def usable_points(points: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor] | None:
    """Start points [N, 3] and colours [N or 0, 3] without those that are not finite; None where none is left."""
    if points is None:
        return None
    finite = torch.isfinite(points[0]).all(dim=1)
    if not finite.any():
        warn("the dataset has no usable 3D points; starting from random ones")
        return None
    return points[0][finite], points[1][finite] if len(points[1]) else points[1]


def give_sizes_to_points_without(log_scales: Tensor) -> None:
    """Give start points that have no distance to their neighbours (they lie on one another) the usual size, in place.

    Args:
        log_scales: [N, 3], -inf or NaN where a point has no size.
    """
    finite = log_scales.isfinite()
    usual = log_scales[finite].median() if finite.any() else log_scales.new_tensor(math.log(LONELY_SIZE))
    torch.where(finite, log_scales, usual, out=log_scales)


def outside_cameras(means: Tensor, positions: Tensor) -> Tensor:
    """[N], True where a start point [N, 3] is not inside any camera at positions [V, 3]."""
    inside = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    for chunk in positions.to(means).split(64):
        inside |= (torch.cdist(means, chunk) < START_DISTANCE).any(dim=1)
    return ~inside


def first_not_finite(state: Any, path: str = "") -> str | None:
    """The name of the first tensor or number of a checkpoint that is not finite, or None."""
    if isinstance(state, Tensor):
        return path if state.is_floating_point() and not torch.isfinite(state).all() else None
    if isinstance(state, float):
        return path if not math.isfinite(state) else None
    entries = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    for key, value in entries:
        found = first_not_finite(value, f"{path}.{key}" if path else str(key))
        if found is not None:
            return found
    return None
