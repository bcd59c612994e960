"""What nerfstudio writes to tensorboard and the like, less often."""

from __future__ import annotations

from typing import Any

from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName

TIMES = frozenset(
    name.value
    for name in (EventName.ITER_TRAIN_TIME, EventName.ETA, EventName.TRAIN_RAYS_PER_SEC, EventName.VIS_RAYS_PER_SEC)
)
"""Names of the times and rates that are written at every step."""
LEARNING_RATES = "learning_rate/"
"""How the names of learning rates begin."""


class SparingWriter:
    """An event writer of nerfstudio's that gets every number at those steps only at which losses are logged.

    nerfstudio 1.1.5 writes times, rates and learning rates at every step (engine/trainer.py:309), which costs half a
    millisecond with tensorboard: more than the optimizers. Times and rates are means over the last steps anyway.
    """

    def __init__(self, inner: Any, every: int) -> None:
        """Take the writer, and the number of steps from one logged step to the next."""
        self._inner, self._every = inner, every

    def write_scalar(self, name: str, scalar: Any, step: int) -> None:
        """Write a number, unless it is one of those and of a step between."""
        if step % self._every == 0 or not (name in TIMES or name.startswith(LEARNING_RATES)):
            self._inner.write_scalar(name, scalar, step)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def spare_event_writers(every: int) -> None:
    """Let the event writers that are set up get numbers at every so many steps."""
    writer.EVENT_WRITERS[:] = [
        each if isinstance(each, writer.LocalWriter) else SparingWriter(each, max(1, every))
        for each in writer.EVENT_WRITERS
    ]
