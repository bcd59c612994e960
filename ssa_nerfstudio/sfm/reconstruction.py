"""Structure from motion in a process of its own: COLMAP's threads abort the process where a disk is full."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

MODEL = "model"
"""Folder of the model that was chosen, in COLMAP's binary files; missing where none was found."""
JOB = "job.json"
"""What the child is to do."""

Report = Callable[[str, int, int], None]
"""Called with the stage's name, how much is done and how much there is."""


@dataclass(frozen=True)
class Pass:
    """Photos of one camera."""

    photos: list[str]
    """Files in the folder of images, in order."""
    folder: str
    """Where features are looked for: copies of the photos, of the same names and size, or the photos themselves."""
    mask: str | None = None
    """File of a mask: no feature lies where it is black; None: features lie everywhere."""


@dataclass(frozen=True)
class Settings:
    """How structure from motion is done."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which pairs are matched; auto: all of them up to 150 photos."""
    max_image_size: int = 1600
    """Longest side of the photos that features are looked for in, pixels."""
    flatten: bool = True
    """Whether features are looked for in photos without what is the same in all of them."""
    filter_stationary: bool = True
    """Whether matches that lie at the same place of both frames (within 4 pixels) are dropped."""
    threads: int = -1
    """-1: one a core."""


def reconstruct(images: Path, passes: Sequence[Pass], folder: Path, settings: Settings, report: Report) -> Path | None:
    """Extracts, matches and maps in a child process that ends with this one, whatever ends it.

    Args:
        images: folder of the photos.
        passes: each has one camera.
        folder: exists; what an earlier run left there is used.
        settings: how.
        report: called with what the child reports.

    Returns:
        The folder of the model, or None where no two photos could be set against each other.

    Raises:
        MemoryError: the child was killed from outside, which is what systems without memory left do.
        OSError: the child ended abnormally, which is how COLMAP tells that it cannot write.
    """
    job = {"images": str(images), "passes": [asdict(each) for each in passes], "settings": asdict(settings)}
    (folder / JOB).write_text(json.dumps(job), encoding="utf-8")
    log = folder / "log.txt"
    with log.open("w") as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", "ssa_nerfstudio.sfm.colmap", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            for line in child.stdout:
                report(*json.loads(line))
            child.wait()
        finally:
            child.kill()
            child.wait()
            child.stdin.close()
            child.stdout.close()
    if child.returncode == -signal.SIGKILL:
        raise MemoryError("structure from motion was killed, most likely for lack of memory: lower --threads")
    if child.returncode:
        raise OSError(f"COLMAP: {_reason(log)}")
    return folder / MODEL if (folder / MODEL).is_dir() else None


def _reason(log: Path) -> str:
    """What COLMAP said before it ended."""
    lines = log.read_text(errors="replace").splitlines()
    said = [line for line in lines if "what():" in line] or [line for line in lines if "Error" in line]
    return " ".join(said[-1].split())[:200] if said else "ended without a word"
