"""Reading text that somebody else may have written."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ssa_nerfstudio.errors import InputError

_PHOTOS = 100_000
_BYTES_PER_PHOTO = 4096
"""transforms.json has 2500 for one with a lens of its own, mask and depth, names of 200 characters, indented by 4."""
MAX_BYTES = _PHOTOS * _BYTES_PER_PHOTO
"""Of the largest text that is read: Python takes 1 to 2 bytes of memory for each once it is parsed."""
MAX_SETTINGS_BYTES = 10_000_000
"""Of the largest YAML that is read: 100,000 values of 100 characters. A run's config.yml has 20,000 bytes."""


def read_text(path: Path, most: int = MAX_BYTES) -> str:
    """The text of a file in UTF-8.

    Args:
        path: a file, which may be behind a link.
        most: how many bytes it may have.

    Raises:
        InputError: it is larger, or no file: a pipe would be waited for, and a device may never end.
        OSError: it cannot be read.
        UnicodeDecodeError: it is no text.
    """
    found = os.stat(path)
    if stat.S_ISFIFO(found.st_mode):
        raise InputError(f"{path} cannot be read (it is a pipe)")
    if stat.S_ISCHR(found.st_mode) or stat.S_ISBLK(found.st_mode):
        raise InputError(f"{path} cannot be read (it is a device)")
    if found.st_size > most:
        raise InputError(
            f"{path} has {found.st_size / 1e6:.0f} MB and is not read",
            f"such files have at most {most / 1e6:.0f} MB"
            + (f", enough for {_PHOTOS:,} photos" if most == MAX_BYTES else ""),
        )
    return path.read_text(encoding="utf-8")
