"""What is written to tensorboard and the like: less than nerfstudio writes at every step, and norms of gradients."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from typing import Any

import torch
from nerfstudio.configs import base_config  # noqa: F401 - before writer, which imports it, and without which it fails
from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName

TIMES = frozenset(
    name.value
    for name in (EventName.ITER_TRAIN_TIME, EventName.ETA, EventName.TRAIN_RAYS_PER_SEC, EventName.VIS_RAYS_PER_SEC)
)
"""Times and rates that nerfstudio writes at every step."""
LEARNING_RATES = "learning_rate/"
"""Prefix of the names of learning rates."""


class ThinnedWriter:
    """An event writer of nerfstudio's that gets times and learning rates only at the steps at which losses are logged.

    nerfstudio 1.1.5 writes times, rates and learning rates at every step (engine/trainer.py:309), which costs half a
    millisecond with tensorboard: more than the optimizers. Times and rates are means over the last steps anyway.
    """

    def __init__(self, inner: Any, every: int) -> None:
        """Wrap a writer; `every` is the number of steps from one logged step to the next."""
        self._inner, self._every = inner, every

    def write_scalar(self, name: str, scalar: Any, step: int) -> None:
        """Write a scalar, unless it is a time or learning rate of a step in between."""
        if step % self._every == 0 or not (name in TIMES or name.startswith(LEARNING_RATES)):
            self._inner.write_scalar(name, scalar, step)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def thin_event_writers(every: int) -> None:
    """Wrap the event writers that are set up."""
    writer.EVENT_WRITERS[:] = [
        each if isinstance(each, writer.LocalWriter) else ThinnedWriter(each, max(1, every))
        for each in writer.EVENT_WRITERS
    ]


@contextmanager
def no_event_writers_left() -> Iterator[None]:
    """Clear, at the end, what nerfstudio keeps of a run in globals: the next run in this process starts with none."""
    try:
        yield
    finally:
        writer.EVENT_WRITERS.clear()
        writer.EVENT_STORAGE.clear()
        writer.GLOBAL_BUFFER.clear()


def gradient_norms(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    """2-norm of every parameter's gradient, and their sum, under nerfstudio's names."""
    norms = {f"Gradients/{name}": p.grad.norm() for name, p in model.named_parameters() if p.grad is not None}
    return {**norms, "Gradients/Total": reduce(torch.add, norms.values())}
