"""What keeps a training step finite. Every decision is taken on the device; the host looks every 100 steps.

None of this is part of the method: it works the same with the overlay off, and `guards: False` in the model's
configuration takes all of it away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from ssa_nerfstudio.errors import give_up, warn
from ssa_nerfstudio.plugin.fused_adam import FusedAdam, count_steps
from ssa_nerfstudio.rasterization.constants import NEAR_PLANE

READ_EVERY = 100
"""Steps between two looks of the host at what the device noted."""
RANGE_EVERY = 10
"""Steps between two moments at which parameters are brought back into their ranges; they leave by at most so many
learning rates."""
SCALE_RANGE = (1e-8, 1e4)
"""Sizes of Gaussians in world units. The smaller is a thousandth of a pixel at the near plane for a focal length of
1000 pixels; with the larger, the determinant of a projected covariance still fits into float32."""
START_DISTANCE = NEAR_PLANE
"""A start point nearer to a camera than this (world units) is inside it: that camera can never draw it."""

THE_LOSS = "the loss"
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
        self.taken: Tensor | None = None
        """1 - skipped."""
        self._optimizers: Mapping[str, torch.optim.Optimizer] = {}
        self._skips: list[Tensor] = []
        self._noted: list[tuple[int, list[bool], Sequence[Tensor]]] = []
        """Of each step: how many terms the loss had, which parameters had a gradient, and the norms of all of them."""
        self._row, self._row_began, self._culprits = 0, 0, ""

    def judge(self, losses: Sequence[Tensor], optimizers: Mapping[str, torch.optim.Optimizer]) -> None:
        """Decide about the step whose gradients the optimisers' parameters hold; no waiting for the device.

        Args:
            losses: the terms of the loss, scalars.
            optimizers: by name.
        """
        if len(self._noted) == len(self._skips):
            self._skips += losses[0].new_zeros(READ_EVERY, dtype=torch.float32).unbind()
            self._one = losses[0].new_ones((), dtype=torch.float32)
        self._optimizers = optimizers
        # Not from a list of old: densification puts new parameters into the optimisers. Names are found where needed.
        gradients = [p.grad for o in optimizers.values() for group in o.param_groups for p in group["params"]]
        values = [*losses, *(gradient for gradient in gradients if gradient is not None)]
        norms = torch._foreach_norm(values)  # pyright: ignore[reportPrivateImportUsage]
        self.skipped = self._skips[len(self._noted)]
        # Sets `skipped` to 1 where a norm is not finite; multiplies the norms by one.
        search = torch._amp_foreach_non_finite_check_and_unscale_  # pyright: ignore[reportPrivateImportUsage]
        search(norms, self.skipped, self._one)
        self.taken = 1 - self.skipped
        self._noted.append((len(losses), [gradient is not None for gradient in gradients], norms))
        fused = [optimizer for optimizer in optimizers.values() if isinstance(optimizer, FusedAdam)]
        count_steps([counter for optimizer in fused for counter in optimizer.counters()], self.taken)
        for optimizer in fused:
            optimizer.refused, optimizer.counted = self.skipped, True

    def watch(self, optimizer: torch.optim.Optimizer) -> None:
        """Let an optimiser take no step that was judged to be skipped."""
        if not isinstance(optimizer, FusedAdam):
            optimizer.register_step_pre_hook(self._before_step)
            optimizer.register_step_post_hook(_forget)

    def _before_step(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        """torch's fused optimisers are told on the device, for others the host has to ask."""
        if self.skipped is None:
            return
        if getattr(optimizer, "_step_supports_amp_scaling", False):
            scalers = getattr(optimizer, "found_inf", None)  # a GradScaler has found something of its own
            if scalers is None:
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
        noted, self._noted = self._noted, []
        skips = torch.stack(self._skips[: len(noted)]).tolist() if noted else []
        self._skips = []
        skipped = int(sum(skips))
        for at, (skip, of_step) in enumerate(zip(skips, noted, strict=True), start=step + 1 - len(noted)):
            if not skip:
                self._row = 0
                continue
            if self._row == 0:
                self._row_began, self._culprits = at, self._described(*of_step)
            self._row += 1
            if self._row >= self.limit:
                raise give_up(
                    f"training stopped at step {step}: {self.limit} steps in a row, from step {self._row_began} on, "
                    f"were skipped because {self._culprits} not finite; resume from an earlier checkpoint (--load-dir) "
                    "with lower learning rates"
                )
        if skipped:
            warn(f"{skipped} of the {len(noted)} steps up to {step} were skipped: {self._culprits} not finite")
        return skipped

    def _described(self, terms: int, present: list[bool], norms: Sequence[Tensor]) -> str:
        """What was not finite: "the loss", "the gradient of scales", and the parameters that are so themselves."""
        parameters = list(_parameters(self._optimizers))
        values = [name for name, p in parameters if not torch.isfinite(p).all()]
        if values:
            return f"{', '.join(values)} (the values themselves) and what follows from them were"
        names = [THE_LOSS] * terms + [name for (name, _), there in zip(parameters, present, strict=True) if there]
        broken = [name for name, norm in zip(names, norms, strict=True) if not math.isfinite(norm)]
        gradients = [name for name in broken if name != THE_LOSS]
        parts = [THE_LOSS] * (THE_LOSS in broken)
        if len(gradients) == sum(present):
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
        losses: Callable[[], Sequence[Tensor]],
    ) -> None:
        super().__init__(config, param_groups)
        self.guard, self._losses = guard, losses
        for optimizer in self.optimizers.values():
            guard.watch(optimizer)

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Judge the step, then step the groups."""
        self.guard.judge(self._losses(), {name: self.optimizers[name] for name in param_groups})
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


def _forget(optimizer: torch.optim.Optimizer, *_: Any) -> None:
    """What one step found is nothing to the next."""
    optimizer.found_inf = None  # pyright: ignore[reportAttributeAccessIssue]


def _parameters(optimizers: Mapping[str, torch.optim.Optimizer]) -> Iterator[tuple[str, Tensor]]:
    """Every parameter with its name, in the order of the optimisers."""
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
