"""What keeps a training step finite. Every decision is taken on the device; the host looks every 100 steps.

None of this is part of the method: it works the same with the overlay off, and `guards: False` in the model's
configuration takes all of it away.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from ssa_nerfstudio.errors import TrainingError
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdam
from ssa_nerfstudio.rasterization.constants import NEAR_PLANE

_LOG = logging.getLogger(__name__)

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

TOO_LARGE = 2.0**64
"""Gradients times this overflow in float32 where their squares do: its largest number is just below 2^128."""
LONELY_SIZE = 0.01
"""Size (world units) of start points that all lie in one place."""


class StepGuard:
    """Decides on the device whether a step may be taken: where the loss and every gradient are finite, and so are the
    squares of all gradients.

    The squares, because one that overflows turns Adam's second moment into infinity, after which that element never
    moves again, or is not finite at the next step.

    All of this is in the number that the backward pass begins with, usually 1 (see `seed`): it makes gradients not
    finite where the loss is not, and so large that those without a finite square overflow. What is left is one search
    through the gradients, which makes them what they were. Powers of two, so that nothing is rounded.
    """

    def __init__(self, limit: int, magnified: bool = True) -> None:
        """Make a guard.

        Args:
            limit: so many skipped steps in a row end the training, at the host's next look.
            magnified: gradients come out of the backward pass `TOO_LARGE` times as large. False where they must not,
                because they have half precision or add up over several steps; then a second search makes them so.
        """
        self.limit = limit
        self.magnification = TOO_LARGE if magnified else 1.0
        """How much too large gradients are between the backward pass and the judgement."""
        self.skipped: Tensor | None = None
        """1 where the current step is skipped, else 0: one float tensor on the device; None before the first step."""
        self._optimizers: Mapping[str, torch.optim.Optimizer] = {}
        self._loss: Tensor | None = None
        self._seed: Tensor | None = None
        self._judged = 0
        """Steps since the last look."""
        self._row, self._row_began = 0, 0

    def seed(self, loss: Tensor) -> Tensor:
        """What the backward pass of a loss [] has to begin with; NaN where it is not finite."""
        if self._seed is None:
            self._seed = torch.full_like(loss, self.magnification, requires_grad=False)
        self._loss = loss.detach()
        return torch.add(self._seed, self._loss, alpha=0)

    def judge(self, optimizers: Mapping[str, torch.optim.Optimizer]) -> Tensor:
        """Decide about the step whose gradients the optimizers' parameters hold; no waiting for the device.

        Args:
            optimizers: all of them by name, whether they step now or gather gradients for later. Gradients become
                `magnification` times smaller, in place: no two may share memory.

        Returns:
            What `skipped` is from now on.
        """
        # Not from a list of old: densification puts new parameters into the optimizers.
        parameters = [p for o in optimizers.values() for group in o.param_groups for p in group["params"]]
        if self._judged == 0:
            self._skips = parameters[0].new_zeros(READ_EVERY, dtype=torch.float32)
            self._skip = self._skips.unbind()
            down = torch.full_like(self._skip[0], 1 / TOO_LARGE)
            self._factors = [down] if self.magnification == TOO_LARGE else [1 / down, down]
        self._optimizers = optimizers
        self.skipped = skipped = self._skip[self._judged]
        self._judged += 1
        gradients = [p.grad for p in parameters if p.grad is not None]
        # torch's only kernel that goes through a list of tensors and leaves a single number: sets `skipped` to 1 where
        # a value is not finite, and multiplies all of them.
        search = torch._amp_foreach_non_finite_check_and_unscale_  # pyright: ignore[reportPrivateImportUsage]
        for factor in self._factors:
            search(gradients, skipped, factor)
        for optimizer in optimizers.values():
            if isinstance(optimizer, FusedAdam):
                optimizer.refused = skipped
        return skipped

    def watch(self, optimizer: torch.optim.Optimizer) -> None:
        """Let an optimizer take no step that was judged to be skipped."""
        if not isinstance(optimizer, FusedAdam):
            optimizer.register_step_pre_hook(self._before_step)
            optimizer.register_step_post_hook(_forget)

    def _before_step(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        """torch's fused optimizers are told on the device, for others the host has to ask."""
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

    def look(self, step: int) -> list[int]:
        """Read what became of the steps since the last look.

        Returns:
            Which of them were skipped; the first is 0.

        Raises:
            TrainingError: where `limit` steps in a row, up to any of them, were skipped.
        """
        if not self._judged:
            return []
        skips = self._skips[: self._judged].tolist()
        self._judged = 0
        skipped = [at for at, skip in enumerate(skips) if skip]
        if not skipped:
            self._row = 0
            return []
        culprits = self._culprits(bool(skips[-1]))
        for at, skip in enumerate(skips, start=step + 1 - len(skips)):
            if not skip:
                self._row = 0
                continue
            if self._row == 0:
                self._row_began = at
            self._row += 1
            if self._row >= self.limit:
                raise TrainingError(
                    f"training stopped at step {step}: {self.limit} steps in a row, from step {self._row_began} on, "
                    f"were skipped because {culprits} not finite",
                    "resume from an earlier checkpoint (--load-dir) with lower learning rates",
                )
        _LOG.warning(f"{len(skipped)} of the {len(skips)} steps up to {step} were skipped: {culprits} not finite")
        return skipped

    def _culprits(self, still_there: bool) -> str:
        """What is not finite: "the loss", "the gradient of scales", and the parameters that are so themselves.

        Args:
            still_there: the last step was skipped, and its loss and gradients can be looked at; those of earlier ones
                are gone, as are gradients that optimizers were kept from, or of parameters that a refinement replaced.
        """
        parameters = list(_parameters(self._optimizers))
        values = [name for name, p in parameters if not torch.isfinite(p).all()]
        if values:
            return f"{', '.join(values)} (the values themselves) and what follows from them were"
        if still_there and self._loss is not None and not torch.isfinite(self._loss):
            return "the loss was"  # and with it every gradient
        present = [name for name, p in parameters if p.grad is not None]
        broken = [name for name, p in parameters if p.grad is not None and not torch.isfinite(p.grad).all()]
        if not (broken and still_there):
            return "the loss or a gradient was"
        if len(broken) > 1 and broken == present:
            return "every gradient was"
        return f"the gradient of {', '.join(broken)} was"


class SeedingScaler(torch.amp.GradScaler):
    """A GradScaler whose losses begin their backward pass with a guard's seed.

    nerfstudio's trainer lets its own scale every loss, whether that one is enabled or not.
    """

    def __init__(self, guard: StepGuard, enabled: bool, device: str = "cuda") -> None:
        """Make a scaler; where it is not enabled, seeding is all that it does."""
        super().__init__(device, enabled=enabled)
        self._guard = guard

    def scale(self, outputs: Tensor) -> SeededLoss:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The loss [] to go back from."""
        return SeededLoss(super().scale(outputs), self._guard)


class SeededLoss:
    """A loss to go back from."""

    def __init__(self, loss: Tensor, guard: StepGuard) -> None:
        self._loss, self._guard = loss, guard

    def backward(self) -> None:
        """Add to the gradients what this loss, seeded, has to give."""
        torch.autograd.backward((self._loss,), (self._guard.seed(self._loss),))


def _forget(optimizer: torch.optim.Optimizer, *_: Any) -> None:
    """What one step found is nothing to the next."""
    optimizer.found_inf = None  # pyright: ignore[reportAttributeAccessIssue]


def _parameters(optimizers: Mapping[str, torch.optim.Optimizer]) -> Iterator[tuple[str, Tensor]]:
    """Every parameter with its name, in the order of the optimizers."""
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
    """Start points [N, 3] and colors [N or 0, 3] without those that are not finite; None where none is left."""
    if points is None:
        return None
    finite = torch.isfinite(points[0]).all(dim=1)
    if not finite.any():
        _LOG.warning("the dataset has no usable 3D points; starting from random ones")
        return None
    return points[0][finite], points[1][finite] if len(points[1]) else points[1]


def give_sizes_to_points_without(log_scales: Tensor) -> None:
    """Give start points that have no distance to their neighbors (they lie on one another) the usual size, in place.

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
