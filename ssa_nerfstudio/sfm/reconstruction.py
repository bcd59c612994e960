"""Structure from motion in a child process.

COLMAP runs threads of its own. When one of them cannot write, because the disk is full, it throws where nothing can
catch it, and the whole process is aborted; COLMAP also replaces the process's signal handlers. In a child process
(`colmap.py`) an abort is an exit code, and the parent can report the problem and keep usable results.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ssa_nerfstudio.sfm.progress_display import ProgressCallback

MODEL = "model"
"""Folder of the chosen model, in COLMAP's binary files; missing where none was found."""
KEPT = "kept.json"
"""File with the names of the photos whose known poses were kept."""
TORN = "torn.json"
"""File with the pairs of names of photos that the model puts apart although their matches are among the strongest."""
JOB = "job.json"
"""File with the child's arguments."""


@dataclass(frozen=True)
class Mount:
    """A camera on a rig whose cameras are all in one place."""

    rig: str
    """Name of the rig."""
    prefix: str
    """How its photos' names begin; what follows is the same for photos of the rig that were taken at once."""
    from_rig: list[list[float]]
    """Rotation [3, 3] of directions from the rig's axes to the camera's."""


@dataclass(frozen=True)
class Pass:
    """Photos of one camera, taken in one pass over the scene."""

    photos: list[str]
    """Files in the folder of images, in order."""
    folder: str
    """Folder in which features are extracted: the photos, or copies of the same names and size."""
    mask: str | None = None
    """File of a mask, black where no feature may lie; None: features may lie everywhere."""
    lens: list[float] | None = None
    """fx, fy, cx, cy, k1, k2, p1, p2 to start from; None: as COLMAP guesses from the photos, with square pixels."""
    mount: Mount | None = None
    """Of a camera on a rig, whose `lens` stays as it is; None: each photo's pose is its own."""


@dataclass(frozen=True)
class SfmSettings:
    """Settings of structure from motion."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which pairs are matched; auto: all of them up to 150 photos, else sequential."""
    max_image_size: int = 1600
    """Longest side of the photos in which features are extracted, pixels."""
    flatten: bool = True
    """Whether features of the first pass are extracted in photos without their static factor (`flat_field`)."""
    filter_stationary: bool = True
    """Whether matches at the same place of both frames (within 4 pixels) are dropped."""
    camera_model: Literal["OPENCV", "OPENCV_FISHEYE"] = "OPENCV"
    """Lens model of all photos."""
    threads: int = -1
    """Number of threads; -1: one per core."""


def reconstruct(
    images: Path,
    passes: Sequence[Pass],
    folder: Path,
    settings: SfmSettings,
    on_progress: ProgressCallback,
    poses: Mapping[str, np.ndarray] | None = None,
) -> Path | None:
    """Extract features, match and map in a child process that ends with this one, even when this one is killed.

    Args:
        images: folder of the photos.
        passes: each has one camera.
        folder: exists; what an earlier run left there is used.
        settings: settings of structure from motion.
        on_progress: called with what the child reports.
        poses: those that are known, camera from world [3, 4], by the photo's name. The folder's KEPT then lists the
            photos that agree with theirs, and the model is where those were.

    Returns:
        The folder of the model, or None where no two photos match.

    Raises:
        MemoryError: the child was killed from outside, which operating systems do when memory runs out.
        OSError: the child ended abnormally, which is how COLMAP reports that it cannot write.
    """
    job = {"images": str(images), "passes": [asdict(each) for each in passes], "settings": asdict(settings)}
    job["poses"] = {name: pose.tolist() for name, pose in (poses or {}).items()}
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
                on_progress(*json.loads(line))
            child.wait()
        finally:
            child.kill()
            child.wait()
            child.stdin.close()
            child.stdout.close()
    if child.returncode == -signal.SIGKILL:
        raise MemoryError("structure from motion was killed, most likely for lack of memory: use fewer threads")
    if child.returncode:
        raise OSError(f"COLMAP: {_reason(log)}")
    return folder / MODEL if (folder / MODEL).is_dir() else None


def _reason(log: Path) -> str:
    """Find COLMAP's last error in its log."""
    lines = log.read_text(errors="replace").splitlines()
    errors = [line for line in lines if "what():" in line] or [line for line in lines if "Error" in line]
    return " ".join(errors[-1].split())[:200] if errors else "ended without a message"
