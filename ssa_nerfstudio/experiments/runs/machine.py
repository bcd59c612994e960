"""The machine that a result comes from: versions, revision, devices, and whether other processes used them."""

from __future__ import annotations

import os
import subprocess
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

PACKAGES = ("torch", "gsplat", "nerfstudio", "numpy", "ssa-nerfstudio")
"""What a result depends on."""
MAX_SHARE_OF_OTHERS = 0.1
"""Share of the cores that other processes may use while a run on the CPU still counts as alone."""


def versions() -> dict[str, str]:
    """Versions of what a result depends on, and the device."""
    import platform

    import torch

    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    found["device"] = (
        torch.cuda.get_device_name() if torch.cuda.is_available() else f"CPU, {torch.get_num_threads()} threads"
    )
    return found


def revision() -> str:
    """The git revision of this code, with `+` where files differ from it; empty outside a checkout."""
    described = ("describe", "--always", "--exclude=*", "--abbrev=12", "--dirty=+")
    return _output("git", "-C", str(Path(__file__).parent), *described).strip()


def devices() -> list[str]:
    """CUDA devices that this process may use, as CUDA_VISIBLE_DEVICES names them; empty without CUDA."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return [name for name in visible.split(",") if name.strip()]
    lines = _output("nvidia-smi", "--list-gpus").splitlines()
    return [str(number) for number, line in enumerate(line for line in lines if line.startswith("GPU "))]


class DeviceSharing:
    """Whether other processes used the device during a run: any process on CUDA, their share of the cores on a CPU."""

    def __init__(self) -> None:
        """Start measuring; to be called before this process initializes CUDA."""
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        self._device = visible.split(",")[0] if visible else ("0" if devices() else None)
        self._shared_at_start = self._processes() > 0
        self._start = time.perf_counter(), _busy(), _own()

    def share_of_cores(self) -> float:
        """Share of the machine's cores that other processes used since the start, in [0, 1]."""
        start, busy, own = self._start
        elapsed = max(1e-3, time.perf_counter() - start)
        others = (_busy() - busy) - (_own() - own)
        return min(1.0, max(0.0, others / elapsed / (psutil.cpu_count() or 1)))

    def alone(self) -> bool:
        """Whether no other use of the device was seen."""
        if self._device is not None:
            return not self._shared_at_start and self._processes() <= 1
        return self.share_of_cores() <= MAX_SHARE_OF_OTHERS

    def _processes(self) -> int:
        """Processes on the CUDA device; 0 where it cannot be asked."""
        if self._device is None:
            return 0
        query = ("-i", self._device, "--query-compute-apps=pid", "--format=csv,noheader")
        return len(_output("nvidia-smi", *query).split())


def _busy() -> float:
    """Seconds that all cores have worked, for all processes."""
    times = psutil.cpu_times()
    return sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)


def _own() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _output(*command: str) -> str:
    """What a command prints; nothing where it cannot be run or fails."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return ""
