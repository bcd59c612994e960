"""The camera groups that a checkpoint holds, of this version or an earlier one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ssa_nerfstudio.cameras.intervals import BEGINNING
from ssa_nerfstudio.errors import InputError


def cameras_in(state: dict[str, Any], prefix: str) -> Tensor:
    """Cameras of its groups [G, 6], of those with an overlay before the others.

    Args:
        state: the model's state dict.
        prefix: of the artifacts' entries in it.
    """
    return torch.cat([state.get(f"{prefix}{name}", torch.zeros(0, 6)) for name in ("camera_keys", "bare_keys")])


def names_in(state: dict[str, Any], prefix: str) -> dict[str, list[str]]:
    """First photos and names of its groups (`Artifacts.starts`, `cameras`), which older checkpoints do not have.

    Args:
        state, prefix: as for `cameras_in`.

    Raises:
        InputError: it is of other groups than the checkpoint has.
    """
    keys = cameras_in(state, prefix).tolist()
    numbers = [[key for at, key in enumerate(keys) if key not in keys[:at]].index(key) for key in keys]
    extra = {"starts": [BEGINNING] * len(keys), "cameras": [f"camera_{number}" for number in numbers]}
    extra |= state.get(f"{prefix}_extra_state", {})
    for name, values in extra.items():
        if len(values) != len(keys):
            raise InputError(
                f"the {name} in the checkpoint are not one for each of its groups of photos", "take another"
            )
    return extra
