"""Results of a measurement in a file, a line of JSON each, to which later calls add."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ssa_nerfstudio._system.name_list import name_list
from ssa_nerfstudio.errors import InputError


def read_lines(path: Path, keys: tuple[str, ...], since: str = "") -> list[dict[str, Any]]:
    """Results of earlier calls.

    Args:
        path: the file; without it there are none.
        keys: entries that every result has, each a text, a number or nothing.
        since: an entry that results of earlier revisions lack; they are left out.

    Raises:
        InputError: the file holds something else.
    """
    if not path.exists():
        return []
    other = f"{path} holds no results of this script", "choose another --output"
    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except ValueError as error:
        raise InputError(f"{other[0]} ({error})", other[1]) from error
    for number, line in enumerate(lines, 1):
        if not isinstance(line, dict) or any(isinstance(line.get(key, []), (list, dict)) for key in keys):
            raise InputError(f"{other[0]} (line {number} does not say {name_list(keys)})", other[1])
    return [line for line in lines if not since or since in line]
