"""A step of all optimizers together, judged and taken in one launch where it is a CUDA graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from ssa_nerfstudio._system.in_place_graphs import RecordedChanges, side_by_side
from ssa_nerfstudio.plugin.training.fused_adam import FusedAdam, count_steps
from ssa_nerfstudio.plugin.training.nonfinite import NonFiniteGuard, Verdict


@torch.no_grad()
def take_steps(
    optimizers: Sequence[FusedAdam], verdict: Verdict | None, rates: Sequence[Tensor | None] | None = None
) -> None:
    """Count and take a step of each optimizer.

    Args:
        optimizers: of one parameter group each where there are rates.
        verdict: of the guard; None: the step is taken.
        rates: learning rates, scalars on the device, in place of the optimizers' own.
    """
    counters = [counter for optimizer in optimizers for counter in optimizer.counters()]
    count_steps(counters, 1 if verdict is None else verdict.taken)
    skipped = None if verdict is None else verdict.skipped
    per_optimizer = zip(optimizers, rates or [None] * len(optimizers), strict=True)
    # Torch gives each block of threads 65,536 numbers, so a small update takes as long as one of a million.
    side_by_side([partial(optimizer.update, skipped, rate=rate) for optimizer, rate in per_optimizer])


class RecordedSteps:
    """Takes steps that are recorded once for all the addresses that they concern.

    Gradients of recorded functions stay where they are. Others are elsewhere at every step, and steps that they belong
    to are taken plainly.
    """

    def __init__(self) -> None:
        self._changes = RecordedChanges()
        self._loss: Tensor | None = None
        self._row = torch.zeros(2)
        self._rates: dict[FusedAdam, tuple[Tensor, float]] = {}

    @staticmethod
    def fits(optimizers: Sequence[torch.optim.Optimizer]) -> bool:
        """Whether steps of these optimizers can be recorded."""
        return bool(optimizers) and all(
            isinstance(each, FusedAdam)
            and len(each.param_groups) == 1
            and all(p.is_cuda for p in each.param_groups[0]["params"])
            for each in optimizers
        )

    @torch.no_grad()
    def __call__(
        self,
        optimizers: Sequence[FusedAdam],
        loss: Tensor,
        guard: NonFiniteGuard | None,
        judged: Mapping[str, torch.optim.Optimizer],
    ) -> None:
        """Judge and take a step.

        Args:
            optimizers: those that step.
            loss: the step's [].
            guard: None: the step is taken.
            judged: all optimizers by name; those that do not step have no gradient.
        """
        if self._loss is None:
            self._loss = torch.zeros((), device=loss.device)
            self._row = torch.zeros(2, device=loss.device)
            self._verdict = Verdict(*self._row.unbind())
        rates = [self._rate(optimizer, loss.device) for optimizer in optimizers]
        place = None if guard is None else guard.next_place(loss, judged)
        held, verdict = self._loss, self._verdict

        def step() -> None:
            if guard is not None:
                verdict.skipped.zero_()
                guard.search(held, verdict)
            take_steps(optimizers, None if guard is None else verdict, rates)

        self._loss.copy_(loss)
        self._changes(step, tuple(address for each in optimizers for address in (id(each), *each.addresses())))
        if place is not None:
            place[0].copy_(self._row)

    def _rate(self, optimizer: FusedAdam, device: torch.device) -> Tensor:
        """An optimizer's learning rate, on the device; written there where it has changed."""
        wanted = float(optimizer.param_groups[0]["lr"])
        if optimizer not in self._rates:
            self._rates[optimizer] = torch.full((), wanted, device=device), wanted
        rate, known = self._rates[optimizer]
        if known != wanted:
            rate.fill_(wanted)
            self._rates[optimizer] = rate, wanted
        return rate
