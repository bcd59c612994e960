"""A folder that appears only when it is complete."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ssa_nerfstudio.errors import InputError


@contextmanager
def staged_folder(output: Path) -> Iterator[Path]:
    """A hidden folder beside `output` to write into, renamed to `output` when the block ends well, else removed.

    Raises:
        InputError: `output` exists, or cannot be written.
    """
    if output.exists():
        raise InputError(f"{output} exists already", "remove it or name another folder with --output")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as scratch:
            folder = Path(scratch) / output.name
            folder.mkdir()
            yield folder
            folder.rename(output)
    except OSError as error:
        raise InputError(
            f"{output} cannot be written ({error})", "free space there or name another --output"
        ) from error
