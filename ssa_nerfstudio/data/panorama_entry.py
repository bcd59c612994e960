"""The entry of transforms.json that says of which equirectangular photos its photos are faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ssa_nerfstudio.cameras.panorama import FACE_NAMES, Face
from ssa_nerfstudio.cameras.projections import FaceName
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError

_KEY = "panorama"


@dataclass(frozen=True)
class Panorama:
    """Equirectangular photos."""

    width: int
    """Pixels; twice the height."""
    faces: tuple[Face, ...]
    """Those that were cut out of them."""


def panorama_entry(width: int, faces: Sequence[Face]) -> dict[str, Any]:
    """What to add to transforms.json; other programs ignore it.

    Args:
        width: of the equirectangular photos, pixels.
        faces: that were cut out of them; photos of one are those with its focal length.
    """
    stated = {"w": width, "h": width // 2, "face_size": faces[0].size, "faces": [face.name for face in faces]}
    return {_KEY: stated}


def read_panorama(transforms: Transforms) -> Panorama | None:
    """The equirectangular photos of a dataset; None where it was made of others.

    Raises:
        InputError: the entry is not what `panorama_entry` writes.
    """
    if _KEY not in transforms.meta:
        return None
    try:
        stated = transforms.meta[_KEY]
        names: list[FaceName] = list(stated["faces"])
        width, size = int(stated["w"]), int(stated["face_size"])
        if not names or not {*names} <= {*FACE_NAMES} or min(width // 2, size) < 1:
            raise ValueError(f"faces {names!r:.80} of {size} pixels in {width}")
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{transforms.path}: {_KEY} is not what ssa process writes ({error!r:.100})", "process the photos again"
        ) from error
    return Panorama(width, tuple(Face(name, size) for name in names))
