"""How long a stretch of work takes on the device, without waiting for it."""

from __future__ import annotations

import time

import torch


class Lap:
    """A stretch of work between now and `end`, by the device's clock where there is one, else by the host's."""

    def __init__(self) -> None:
        self._events = [torch.cuda.Event(enable_timing=True) for _ in range(2)] if torch.cuda.is_available() else []
        self._start = self._mark(0)

    def _mark(self, which: int) -> float:
        if self._events:
            self._events[which].record()
        return time.perf_counter()

    def end(self) -> None:
        """Until here."""
        self._seconds = self._mark(1) - self._start

    def seconds(self) -> float:
        """How long it took; waits for the device."""
        if not self._events:
            return self._seconds
        self._events[1].synchronize()
        return self._events[0].elapsed_time(self._events[1]) / 1e3
