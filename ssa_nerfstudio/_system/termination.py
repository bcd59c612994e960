"""SIGTERM, and a terminal that is closed: commands end as on ctrl+c, and remove what is half-written."""

from __future__ import annotations

import inspect
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""What asks a process to end, beside ctrl+c. SIGQUIT does, too, and wants a dump of memory."""
_AGAIN = 0.05
"""Seconds after which a signal is looked at again that came where Python cannot be interrupted."""


def exit_code(number: int) -> int:
    """Of a command that a signal ended, as shells have it."""
    return 128 + number


@contextmanager
def handled(handler: Callable[[int, FrameType | None], object], signals: list[signal.Signals]) -> Iterator[None]:
    """Let a handler hold for signals while the block runs.

    Elsewhere than in the main thread, where Python takes no handlers, nothing changes. Neither does it for a signal
    that the process ignores, as after `nohup`.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    kept = (signal.SIG_IGN, None)
    before = {number: signal.signal(number, handler) for number in signals if signal.getsignal(number) not in kept}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def as_ctrl_c() -> Iterator[None]:
    """Let a signal that asks the process to end raise KeyboardInterrupt in the block, once.

    It waits for the end of an import, and so does ctrl+c: libraries' C++ ends the process with a traceback of its own
    where an exception comes in between.

    Raises:
        SystemExit: there was a signal; the exit code names it, whatever became of the KeyboardInterrupt.
    """
    received: list[int] = []
    imports = _imports(inspect.currentframe())
    former = sys.unraisablehook

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _imports(frame) > imports:
            _send_again(number)
        elif number == signal.SIGINT:
            raise KeyboardInterrupt
        elif not received:  # a terminal's end sends two, and the second would interrupt what cleans up after the first
            received.append(number)
            raise KeyboardInterrupt

    def hook(swallowed: sys.UnraisableHookArgs) -> None:
        """Of an exception that Python drops, as in a destructor."""
        if isinstance(swallowed.exc_value, KeyboardInterrupt):
            _send_again(received.pop() if received else signal.SIGINT)
        else:
            former(swallowed)

    with handled(interrupt, [signal.SIGINT, *SIGNALS]):
        sys.unraisablehook = hook
        try:
            yield
        finally:
            sys.unraisablehook = former
            if received:
                raise SystemExit(exit_code(received[0]))


@contextmanager
def ended_at_once(program: str) -> Iterator[None]:
    """End the process where a signal asks for it: nothing has begun, and libraries make other errors of interrupts.

    For imports of seconds, whose end `as_ctrl_c` would wait for.
    """

    def end(number: int, _frame: object) -> None:
        with suppress(OSError):
            os.write(2, f"{program} was stopped\n".encode())
        os._exit(exit_code(number))

    with handled(end, [signal.SIGINT, *SIGNALS]):
        yield


def _imports(frame: FrameType | None) -> int:
    """How many imports are under way in a frame; what is imported already counts for none."""
    return sum(above.f_code.co_filename.startswith("<frozen importlib") for above, _ in traceback.walk_stack(frame))


def _send_again(number: int) -> None:
    main = threading.main_thread().ident
    assert main is not None
    timer = threading.Timer(_AGAIN, signal.pthread_kill, (main, number))
    timer.daemon = True
    timer.start()
