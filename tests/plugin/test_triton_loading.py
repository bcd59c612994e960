"""Triton, loaded ahead of the first step."""

from __future__ import annotations

import sys
import threading
from types import ModuleType

import pytest

from ssa_nerfstudio.plugin import triton_loading
from ssa_nerfstudio.plugin.triton_loading import load_triton_meanwhile


def loaded(monkeypatch, triton_cache: ModuleType) -> None:
    """Load with a module in place of Triton's, and wait for the thread."""
    monkeypatch.setattr(triton_loading.importlib.util, "find_spec", lambda name: object())
    for name, module in (("triton", ModuleType("triton")), ("triton.runtime", ModuleType("triton.runtime"))):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "triton.runtime.cache", triton_cache)
    load_triton_meanwhile()
    for thread in threading.enumerate():
        if thread.name == "ssa-triton":
            thread.join()


def test_the_hash_of_tritons_files_is_computed_in_a_thread(monkeypatch):
    module, threads = ModuleType("triton.runtime.cache"), []
    module.triton_key = lambda: threads.append(threading.current_thread())  # pyright: ignore[reportAttributeAccessIssue]
    loaded(monkeypatch, module)
    assert [thread.name for thread in threads] == ["ssa-triton"]


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_another_version_of_triton_is_loaded_by_the_first_step(monkeypatch):
    loaded(monkeypatch, ModuleType("triton.runtime.cache"))  # without triton_key


def test_the_installed_triton_has_what_is_loaded_ahead():
    cache = pytest.importorskip("triton.runtime.cache")
    assert callable(cache.triton_key)


def test_without_triton_there_is_no_thread(monkeypatch):
    monkeypatch.setattr(triton_loading.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(triton_loading, "Thread", lambda **settings: pytest.fail("a thread was made"))
    load_triton_meanwhile()
