"""Programs that change tensors in place, as CUDA graphs: repeated, recorded by what they change, or side by side."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import cache

import torch
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import (
    CapturedPrograms,
    graphs_are_usable,
    has_cuda,
    warn_of_plain_launches,
)


def repeat(program: Callable[[], object], times: int, device: torch.device) -> None:
    """Run a program that changes tensors in place a number of times, on CUDA as a graph from the second time on.

    Args:
        program: it draws no random numbers, reads nothing from the device and launches the same kernels every time.
        times: at least 1.
        device: of the program's tensors, as they state it.
    """
    # A graph is captured from a stream of the current device: on another one, nothing would be in it.
    if device.type != "cuda" or not graphs_are_usable() or device.index != torch.cuda.current_device():
        for _ in range(times):
            program()
        return
    changes = RecordedChanges()
    for _ in range(times):
        changes(program, key=None)
    torch.cuda.current_stream().synchronize()  # the graph must not be destroyed while it runs


def side_by_side(programs: Sequence[Callable[[], object]]) -> None:
    """Run programs that do not depend on each other: as branches of a graph in a capture, elsewhere in turn.

    Of kernels that leave most of the device idle, a graph runs several at a time.
    """
    if not (has_cuda() and torch.cuda.is_current_stream_capturing()):
        for program in programs:
            program()
        return
    trunk = torch.cuda.current_stream()
    branches = _branch_streams(trunk.device_index, len(programs))
    for branch, program in zip(branches, programs, strict=True):
        branch.wait_stream(trunk)
        with torch.cuda.stream(branch):
            program()
    for branch in branches:
        trunk.wait_stream(branch)


@cache
def _branch_streams(device: int, count: int) -> list[torch.cuda.Stream]:
    return [torch.cuda.Stream(device) for _ in range(count)]


class RecordedChanges:
    """Runs programs that change tensors in place: plainly at first, from the second time on as CUDA graphs."""

    def __init__(self, limit: int = 8) -> None:
        """Record nothing yet; at most `limit` programs are remembered."""
        self._limit = limit
        self._record: CapturedPrograms | None = None
        self._known: dict[Hashable, Callable[[], object] | None] = {}
        self._failed = False

    def __call__(self, program: Callable[[], object], key: Hashable) -> None:
        """Run a program once.

        Args:
            program: it launches the same kernels whenever the key is the same.
            key: the addresses and sizes of all tensors that it reads or changes, and what else it depends on.
        """

        def once() -> list[Tensor]:
            program()
            return []

        recorded = self._known.get(key)
        if recorded is None and key in self._known and not self._failed:
            try:
                self._record = self._record or CapturedPrograms()
                _, recorded = self._record.capture(once)
                self._known[key] = recorded
            except RuntimeError as error:
                self._failed = True
                warn_of_plain_launches(error)
        elif recorded is None:
            self._known[key] = None
            if len(self._known) > self._limit:
                del self._known[next(iter(self._known))]
                if not any(self._known.values()):
                    self._record = None  # nothing can be captured into a pool whose last graph is gone
        (recorded or program)()
