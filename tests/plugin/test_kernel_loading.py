"""Triton and CUDA's kernels, loaded ahead of the first step."""

from __future__ import annotations

import sys
import threading
from types import ModuleType

import pytest
import torch

from ssa_nerfstudio.plugin import kernel_loading
from ssa_nerfstudio.plugin.kernel_loading import load_kernels_meanwhile, rehearse_start

THREADS = {"ssa-triton", "ssa-kernels"}
CPU = torch.device("cpu")


def loaded(monkeypatch, triton_cache: ModuleType | None) -> None:
    """Load with a module in place of Triton's, or with none, and wait for the threads."""
    monkeypatch.setattr(kernel_loading.importlib.util, "find_spec", lambda name: triton_cache)
    for name, module in (("triton", ModuleType("triton")), ("triton.runtime", ModuleType("triton.runtime"))):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "triton.runtime.cache", triton_cache)
    load_kernels_meanwhile(CPU)
    for thread in threading.enumerate():
        if thread.name in THREADS:
            thread.join()


@pytest.fixture
def rehearsals(monkeypatch) -> list[str]:
    """Names of the threads that rehearse."""
    names: list[str] = []
    monkeypatch.setattr(kernel_loading, "rehearse_start", lambda device: names.append(threading.current_thread().name))
    return names


def test_tritons_hash_and_the_starts_kernels_are_loaded_in_threads(monkeypatch, rehearsals):
    module, threads = ModuleType("triton.runtime.cache"), []
    module.triton_key = lambda: threads.append(threading.current_thread())  # pyright: ignore[reportAttributeAccessIssue]
    loaded(monkeypatch, module)
    assert [thread.name for thread in threads] == ["ssa-triton"]
    assert rehearsals == ["ssa-kernels"]


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_what_cannot_be_loaded_ahead_is_left_to_the_start(monkeypatch):
    monkeypatch.setattr(kernel_loading, "sample_points", lambda *arguments: 1 / 0)
    loaded(monkeypatch, ModuleType("triton.runtime.cache"))  # without triton_key


def test_without_triton_nothing_of_it_is_loaded(monkeypatch, rehearsals):
    monkeypatch.setattr(kernel_loading, "_load_triton", lambda: pytest.fail("it was"))
    loaded(monkeypatch, None)
    assert rehearsals == ["ssa-kernels"]


def test_the_installed_triton_has_what_is_loaded_ahead():
    cache = pytest.importorskip("triton.runtime.cache")
    assert callable(cache.triton_key)


def test_a_rehearsal_goes_through_all_of_its_parts_and_leaves_random_state_alone(monkeypatch):
    """Samples, a falloff's regression, distant directions and gaps: none ends early because it found nothing."""
    found = {}
    for name in ("sample_points", "estimate_falloff", "seeds_between"):
        function = getattr(kernel_loading, name)
        monkeypatch.setattr(
            kernel_loading, name, lambda *given, name=name, function=function: found.setdefault(name, function(*given))
        )
    before = torch.get_rng_state()
    rehearse_start(CPU)
    assert torch.equal(torch.get_rng_state(), before)
    assert len(found["sample_points"].point) > 1000
    assert found["estimate_falloff"].shape == (180, 240, 1)
    assert len(found["seeds_between"].gaps) > 0
