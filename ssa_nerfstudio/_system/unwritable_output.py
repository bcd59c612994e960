"""Why an output cannot be written, in words."""

from __future__ import annotations

import os
from pathlib import Path

from ssa_nerfstudio.errors import InputError


def unwritable(path: Path, error: OSError) -> InputError:
    """What to tell a user of an output, a file or a folder, whose writing raised an error."""
    file = next((parent for parent in path.parents if os.path.isfile(parent)), None)  # where no name is too long
    if file is not None:
        return InputError(f"{path} cannot be written: {file} is a file", "choose another place")
    return InputError(f"{path} cannot be written ({error})", "free space there or choose another place")
