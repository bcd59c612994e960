"""Checkpoints that are whole or not there: written beside their folder, moved in when complete."""

from __future__ import annotations

import os
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

PARTIAL = "checkpoint.partial"
"""Folder in a run's own folder where a checkpoint is written. A run that is killed while it writes leaves it behind;
it is never read. (Not in the checkpoints' folder, in which nerfstudio takes every name for a checkpoint's.)"""


def step_of(checkpoint: Path) -> int:
    """The step of a file step-000001999.ckpt."""
    return int(checkpoint.stem.removeprefix("step-"))


def newest_first(folder: Path) -> list[Path]:
    """The checkpoints of a folder."""
    return sorted((path for path in folder.glob("step-*.ckpt") if path.stem[5:].isdigit()), key=step_of, reverse=True)


def damage(checkpoint: Path) -> str | None:
    """What is wrong with a checkpoint's file, or None. torch.load compares no checksums."""
    try:
        with zipfile.ZipFile(checkpoint) as archive:
            wrong = archive.testzip()
    except (zipfile.BadZipFile, OSError) as error:
        return str(error)
    return None if wrong is None else f"the checksum of {wrong} in it is wrong"


@contextmanager
def written_whole(folder: Path) -> Iterator[Path]:
    """Lend a folder to write into; what lies there at the end is moved into `folder` at once, name by name.

    After an error nothing of it remains and `folder` is what it was.
    """
    partial = folder.parent / PARTIAL
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        for path in partial.iterdir():
            # The data before the name: a machine that loses its power must not keep the name alone.
            with path.open("rb") as file:
                os.fsync(file.fileno())
            folder.mkdir(parents=True, exist_ok=True)
            path.replace(folder / path.name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def saved_pipeline(checkpoint: Path) -> dict[str, Any] | None:
    """The pipeline's state in a checkpoint, mapped and not read; None where the file is none."""
    try:
        return torch.load(checkpoint, map_location="cpu", mmap=True, weights_only=True)["pipeline"]
    except (RuntimeError, OSError, EOFError, UnpicklingError, LookupError, TypeError, ValueError):
        return None
