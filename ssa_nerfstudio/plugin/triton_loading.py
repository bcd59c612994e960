"""Triton, for which the first training step would wait, loaded while photos are decoded."""

from __future__ import annotations

import importlib.util
import logging
from threading import Thread

_LOG = logging.getLogger(__name__)


def load_triton_meanwhile() -> None:
    """Let a thread import Triton and hash its files, by whose hash it finds the kernels that it compiled before.

    Half a second that other threads can use, because hashing holds no lock.
    """
    if importlib.util.find_spec("triton") is not None:
        Thread(target=_load_triton, name="ssa-triton", daemon=True).start()


def _load_triton() -> None:
    try:
        from triton.runtime.cache import triton_key

        triton_key()
    except Exception as error:  # another version: the first step does it, and says what is wrong
        _LOG.debug(f"Triton was not loaded ahead: {error}")
