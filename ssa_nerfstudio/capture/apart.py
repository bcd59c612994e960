"""Structure from motion in a process of its own: COLMAP's threads abort the process where a disk is full."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ssa_nerfstudio.capture.structure import Pass, Report, Settings

MODEL = "model"
"""Folder of the model that was chosen, in COLMAP's binary files; missing where none was found."""


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
        OSError: the child ended abnormally, which is how COLMAP tells that it cannot write.
    """
    job = {"images": str(images), "passes": [asdict(each) for each in passes], "settings": asdict(settings)}
    log = folder / "log.txt"
    with log.open("w") as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", "ssa_nerfstudio.capture.structure", json.dumps(job), str(folder)],
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
    if child.returncode:
        raise OSError(f"COLMAP: {_reason(log)}")
    return folder / MODEL if (folder / MODEL).is_dir() else None


def _reason(log: Path) -> str:
    """What COLMAP said before it ended."""
    lines = log.read_text(errors="replace").splitlines()
    said = [line for line in lines if "what():" in line] or [line for line in lines if "Error" in line]
    return " ".join(said[-1].split())[:200] if said else "ended without a word"
