"""Checkpoint files: written beside their folder and moved in when complete, checked when read."""

from __future__ import annotations

import re
import textwrap
import zipfile
import zlib
from contextlib import AbstractContextManager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from ssa_nerfstudio.data.writing import staged_files

PARTIAL = "checkpoint.partial"
"""Folder of a run in which a checkpoint is written; a killed run leaves it behind, and it is never read. It is not in
the checkpoints' folder, because nerfstudio takes every name there for a checkpoint's."""
LOAD_ERRORS = (RuntimeError, OSError, EOFError, UnpicklingError, LookupError, TypeError, ValueError, OverflowError)
"""What `torch.load` and a state dict raise for a file that is no usable checkpoint."""
_FOLDER = 0x10
"""Attribute of a folder in a zip archive. `torch.load` reads nothing of such an entry, and leaves memory as it is."""


def step_of(checkpoint: Path) -> int:
    """The step of a file step-000001999.ckpt."""
    return int(checkpoint.stem.removeprefix("step-"))


def newest_first(folder: Path) -> list[Path]:
    """The checkpoints of a folder; none where there is no such folder.

    Raises:
        PermissionError: the folder may not be read, which `glob` takes for empty.
    """
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if re.fullmatch(r"step-\d+\.ckpt", path.name, re.ASCII)]
    return sorted(found, key=step_of, reverse=True)


def damage(checkpoint: Path) -> str | None:
    """The reason why a checkpoint's file is damaged, or None. (`torch.load` compares no checksums.)"""
    if not checkpoint.is_file():
        return "it is no file"
    try:
        with zipfile.ZipFile(checkpoint) as archive:
            wrong = archive.testzip()
            folders = [entry.filename for entry in archive.infolist() if entry.external_attr & _FOLDER]
    # zipfile raises whatever a broken directory leads it to.
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, ValueError) as error:
        return str(error) or type(error).__name__
    if folders:
        return f"{folders[0]} in it is marked as a folder"
    return None if wrong is None else f"the checksum of {wrong} in it is wrong"


def reason(error: Exception) -> str:
    """Why a checkpoint cannot be loaded, in one line; without torch's advice to load it without its safeguard."""
    if isinstance(error, UnpicklingError):
        return "it holds more than tensors and numbers, and loading it might run code"
    return textwrap.shorten(str(error) or type(error).__name__, 200)


def staged_checkpoints(folder: Path) -> AbstractContextManager[Path]:
    """A folder to write into, whose files are moved into `folder` when the block ends (`data.writing.staged_files`)."""
    return staged_files(folder, folder.parent / PARTIAL)


def load_pipeline_state(checkpoint: Path) -> dict[str, Any] | None:
    """The pipeline's state in a checkpoint, memory-mapped; None where it cannot be read."""
    try:
        return torch.load(checkpoint, map_location="cpu", mmap=True, weights_only=True)["pipeline"]
    except LOAD_ERRORS:
        return None
