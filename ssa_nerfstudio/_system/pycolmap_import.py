"""Importing pycolmap into a process that does other things, too."""

from __future__ import annotations

import signal
import threading
from types import ModuleType


def import_pycolmap() -> ModuleType:
    """The library, whose import leaves SIGTERM as it was.

    COLMAP prints a C++ stack at SIGTERM. Loaded before PIL, it aborts the process that saves a PNG.
    """
    import PIL.Image  # noqa: F401

    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    # Elsewhere than in the main thread Python cannot set handlers. None is one that C code has set before.
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    return pycolmap
