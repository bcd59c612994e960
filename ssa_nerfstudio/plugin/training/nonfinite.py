"""Decisions of a training about values that are not finite: steps, Gaussians, seed points, checkpoints.

A step is judged on the device; the host reads the verdicts every `CHECK_EVERY` steps, so that no step waits for it.
None of this is part of the method. `guards: False` in the model's settings switches off all but the checks of seed
points and checkpoints.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.errors import TrainingError

CHECK_EVERY = 100
"""Steps between two moments at which the host reads the verdicts."""
CLAMP_EVERY = 10
"""Steps between two moments at which parameters are clamped; they leave their range by at most as many learning
rates."""
SCALE_RANGE = (1e-8, 1e4)
"""Range of the Gaussians' scales, world units. The lower bound is a thousandth of a pixel at the near plane for a focal
length of 1000 pixels; at the upper one the determinant of a projected covariance still fits into float32."""
SQUARE_LIMIT = 2.0**64
"""Magnitude from which on the square of a float32 overflows."""
REMOVED_OPACITY = -15.0
"""Opacity logit of a Gaussian that is to be removed."""
LONELY_SCALE = 0.01
"""Scale (world units) of seed points that all lie in one place."""
_LOG = logging.getLogger(__name__)


class Verdict(NamedTuple):
    """Whether a step is taken: two scalars [] on the device, one of which is 1 and the other 0."""

    taken: Tensor
    skipped: Tensor


class NonFiniteGuard:
    """Decides on the device whether a training step is taken.

    A step is skipped where the loss or a gradient is not finite, or where the square of a gradient is not: Adam's
    second moment would become infinite, and the element would never move again. All optimizers skip together.
    """

    def __init__(self, max_skipped_steps: int) -> None:
        """Make a guard.

        Args:
            max_skipped_steps: so many skipped steps in a row end the training, at the host's next check.
        """
        self._max_skipped_steps = max_skipped_steps
        self._optimizers: Mapping[str, torch.optim.Optimizer] = {}
        self._loss: Tensor | None = None
        self._rows = torch.zeros(0, 2)
        self._places: list[tuple[Tensor, Verdict]] = []
        self._factors: tuple[Tensor, ...] = ()
        self._judged = 0
        self._run_length, self._run_start = 0, 0

    def judge(self, loss: Tensor, optimizers: Mapping[str, torch.optim.Optimizer]) -> Verdict:
        """Judge the step whose gradients the parameters hold, without waiting for the device.

        Args:
            loss: the step's loss [].
            optimizers: all of them by name, also those that only accumulate gradients at this step. No two gradients
                may share memory.
        """
        _, verdict = self.next_place(loss, optimizers)
        assert self._loss is not None
        self.search(self._loss, verdict)
        return verdict

    def next_place(self, loss: Tensor, optimizers: Mapping[str, torch.optim.Optimizer]) -> tuple[Tensor, Verdict]:
        """Where the verdict on this step belongs, for the host to read it, as a row [2] and as its two parts.

        `judge` without judging.
        """
        if self._judged == 0:
            # New storage, because what the previous window returned may still be in use on the device.
            self._rows = loss.new_zeros(CHECK_EVERY, 2, dtype=torch.float32, requires_grad=False)
            columns = [column.unbind() for column in self._rows.unbind(dim=1)]
            verdicts = [Verdict(*pair) for pair in zip(*columns, strict=True)]
            self._places = [*zip(self._rows.unbind(), verdicts, strict=True)]
            if not self._factors or self._factors[0].device != loss.device:  # recorded steps know where they are
                self._factors = loss.new_tensor([SQUARE_LIMIT, 1 / SQUARE_LIMIT], dtype=torch.float32).unbind()
        self._optimizers, self._loss = optimizers, loss.detach().float()
        place = self._places[self._judged]
        self._judged += 1
        return place

    def search(self, loss: Tensor, verdict: Verdict) -> None:
        """Write a verdict whose `skipped` was 0, by a loss [] in float32 and the gradients of the last optimizers."""
        # Densification replaces parameters, so the list is rebuilt at every step.
        values = [loss, *(p.grad for _, p in _parameters(self._optimizers) if p.grad is not None)]
        # One kernel over a list of tensors sets `skipped` where a value is not finite, and multiplies all of them. The
        # second call finds what overflowed in the first, and restores all other values: powers of two round nothing.
        search = torch._amp_foreach_non_finite_check_and_unscale_  # pyright: ignore[reportPrivateImportUsage]
        for factor in self._factors:
            search(values, verdict.skipped, factor)
        torch.logical_not(verdict.skipped, out=verdict.taken)

    def tell_densification(self, info: dict[str, Any]) -> None:
        """Tell the densification whether the step that was judged last is taken.

        Args:
            info: the rasterizer's; `taken` is added, 1, or 0 for a skipped step.
        """
        info["taken"] = self._places[self._judged - 1][1].taken

    def check(self, step: int) -> int:
        """Read the verdicts since the last check; call it after `CHECK_EVERY` steps at most.

        Returns:
            How many steps were skipped.

        Raises:
            TrainingError: `max_skipped_steps` in a row were skipped.
        """
        if not self._judged:
            return 0
        skips = [bool(value) for value in self._rows[: self._judged, 1].tolist()]
        self._judged = 0
        if not any(skips):
            self._run_length = 0
            return 0
        culprits = self._culprits(last_was_skipped=skips[-1])
        for number, skipped in enumerate(skips, start=step + 1 - len(skips)):
            self._run_start = number if self._run_length == 0 else self._run_start
            self._run_length = self._run_length + 1 if skipped else 0
            if self._run_length >= self._max_skipped_steps:
                raise TrainingError(
                    f"training stopped at step {step}: {self._run_length} steps in a row, from step {self._run_start} "
                    f"on, were skipped because {culprits} not finite",
                    "resume from an earlier checkpoint (--load-dir) with lower learning rates",
                )
        _LOG.warning(f"skipped {sum(skips)} of {counted(len(skips), 'step')} up to {step}: {culprits} not finite")
        return sum(skips)

    def _culprits(self, last_was_skipped: bool) -> str:
        """What is not finite, as the subject of a sentence: "the gradient of scales was".

        Only the last step's loss and gradients can still be inspected.
        """
        parameters = list(_parameters(self._optimizers))
        values = [name for name, p in parameters if not torch.isfinite(p).all()]
        if values:
            return f"{', '.join(values)} (the values themselves) and what follows from them were"
        if not last_was_skipped or self._loss is None:
            return "the loss or a gradient was"
        if not torch.isfinite(self._loss):
            return "the loss was"  # and with it every gradient
        present = [name for name, p in parameters if p.grad is not None]
        broken = [name for name, p in parameters if p.grad is not None and not _squares_are_finite(p.grad)]
        if not broken:  # a refinement replaced the parameters since
            return "the loss or a gradient was"
        return (
            "every gradient was"
            if broken == present and len(broken) > 1
            else f"the gradient of {', '.join(broken)} was"
        )


def _parameters(optimizers: Mapping[str, torch.optim.Optimizer]) -> Iterator[tuple[str, Tensor]]:
    """Every parameter with its name, in the order of the optimizers."""
    for name, optimizer in optimizers.items():
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        for number, parameter in enumerate(parameters):
            yield (name if len(parameters) == 1 else f"{name}[{number}]"), parameter


def _squares_are_finite(values: Tensor) -> bool:
    return bool((values.abs() < SQUARE_LIMIT).all())


@torch.no_grad()
def clamp_scales(log_scales: Tensor) -> None:
    """Clamp log scales [N, 3] to `SCALE_RANGE`, in place."""
    log_scales.clamp_(math.log(SCALE_RANGE[0]), math.log(SCALE_RANGE[1]))


@torch.no_grad()
def mark_for_removal(params: ParameterDict | dict[str, Parameter]) -> Tensor:
    """Make Gaussians with a value that is not finite transparent, so that the densification removes them.

    Returns:
        [N] bool, True where a Gaussian is not finite.
    """
    broken = torch.stack([~torch.isfinite(p).flatten(1).all(dim=1) for p in params.values()]).any(dim=0)
    params["opacities"].masked_fill_(broken[:, None], REMOVED_OPACITY)
    return broken


def finite_points(points: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor] | None:
    """Seed points [N, 3] and colors [N or 0, 3] that are finite; None where none is left."""
    if points is None:
        return None
    finite = torch.isfinite(points[0]).all(dim=1)
    if not finite.any():
        _LOG.warning("the dataset has no usable 3D points; starting from random ones")
        return None
    if missing := len(finite) - int(finite.sum()):
        _LOG.warning(f"{missing} of the dataset's {len(finite)} 3D points are not finite; they are left out")
    return points[0][finite], points[1][finite] if len(points[1]) else points[1]


def replace_nonfinite_scales(log_scales: Tensor) -> None:
    """Give seed points without a distance to their neighbors (they coincide) the median scale, in place.

    Args:
        log_scales: [N, 3], -inf or NaN where a point has no scale.
    """
    finite = log_scales.isfinite()
    usual = log_scales[finite].median() if finite.any() else log_scales.new_tensor(math.log(LONELY_SCALE))
    torch.where(finite, log_scales, usual, out=log_scales)


def first_nonfinite(state: Any, path: str = "") -> str | None:
    """Name of the first tensor or number of a nested state that is not finite, or None."""
    if isinstance(state, Tensor):
        return path if state.is_floating_point() and not torch.isfinite(state).all() else None
    if isinstance(state, float):
        return path if not math.isfinite(state) else None
    entries = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    for key, value in entries:
        found = first_nonfinite(value, f"{path}.{key}" if path else str(key))
        if found is not None:
            return found
    return None
