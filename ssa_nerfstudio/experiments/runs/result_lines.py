"""Results of a measurement in a file, a line of JSON each, to which later calls add."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ssa_nerfstudio.errors import InputError


def read_lines(path: Path, keys: tuple[str, ...], since: str = "") -> list[dict[str, Any]]:
    """Results of earlier calls.

    Args:
        path: the file; without it there are none.
        keys: entries that every result has.
        since: an entry that results of earlier revisions lack; they are left out.

    Raises:
        InputError: the file holds something else.
    """
    if not path.exists():
        return []
    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        lines = [line for line in lines if not since or since in line]
        for line in lines:
            _ = [line[key] for key in keys]
        return lines
    except (ValueError, TypeError, LookupError) as error:
        raise InputError(f"{path} holds no results of this script ({error})", "choose another --output") from error
