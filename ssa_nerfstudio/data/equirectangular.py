"""Equirectangular photos, recognized by their pixels."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from ssa_nerfstudio.cameras.panorama import FACE_NAMES, panorama_faces
from ssa_nerfstudio.cameras.projections import FaceName, Projection
from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.errors import InputError

_LOG = logging.getLogger(__name__)

_LOOKED_AT = 5
"""Photos, or frames of videos, that are looked at."""
_ROWS = 256
"""Height to which they are reduced: noise and seams of stitching average out."""
_MAX_STEP = 3.0
"""How many times larger than between neighboring columns the difference of the first and the last may be."""
_MAX_POLE = 0.35
"""How much a pole's row may vary along the frame, of what the median row does; the edges' columns vary more."""
_LEVELS = 2.0
"""Gray levels by which anything may differ."""


def with_faces(
    sources: Sequence[Source], projection: Projection = "auto", left_out: Sequence[FaceName] = ()
) -> list[Source]:
    """Give equirectangular sources their faces.

    Args:
        sources: of one capture.
        projection: of all photos, or auto.
        left_out: faces that are not wanted.

    Raises:
        InputError: photos that are to be equirectangular are not 2:1, faces of other photos are left out, or all are.
    """
    if len({*left_out}) == len(FACE_NAMES):
        raise InputError("--leave-out leaves no face", "keep at least one")
    faces = []
    for source in sources:
        twice = source.width == 2 * source.height
        if projection == "equirectangular" and not twice:
            raise InputError(
                f"{source.path} holds photos of {source.width} x {source.height}, equirectangular ones are 2:1",
                "export them without cropping, or leave --projection out",
            )
        if projection == "equirectangular" or (projection == "auto" and twice and wraps_around(source)):
            faces.append(panorama_faces(source.width, left_out))
        else:
            if projection == "auto" and twice:
                _LOG.warning(
                    f"the 2:1 photos of {source.path} are taken for perspective ones: their edges do not continue each "
                    "other, or neither pole is a single color (--projection equirectangular cuts them into faces)"
                )
            faces.append(())
    if left_out and not any(faces):
        raise InputError(
            f"--leave-out is for equirectangular photos, and those in {sources[0].path} are not taken for such",
            "leave it out, or add --projection equirectangular",
        )
    return [replace(source, faces=each) for source, each in zip(sources, faces, strict=True)]


def cut_into_faces(source: Source) -> str:
    """One line that says what is made of a source with faces, and which option overrides it."""
    names = ", ".join(face.name for face in source.faces)
    return (
        f"{source.path} is taken for equirectangular ({source.width} x {source.height}): cut into perspective faces of "
        f"{source.faces[0].size} pixels ({names}). (--projection perspective takes the photos as they are.)"
    )


def wraps_around(source: Source) -> bool:
    """Whether 2:1 photos are equirectangular: the left edge continues the right one, and a pole is one color.

    One pole: over the other an editor may have written something, or laid a logo.

    Decided by the median of five photos, evenly spaced.

    Raises:
        InputError: a photo cannot be decoded.
    """
    if source.videos:
        pictures = list(source.videos[0].spread(_LOOKED_AT))
    else:
        step = -(-len(source.photos) // _LOOKED_AT)
        pictures = [read_photo(path, upright=True) for path in source.photos[::step]]
    return bool(np.median([_wraps_around(picture) for picture in pictures]) == 1)


def _wraps_around(picture: np.ndarray) -> bool:
    scale = min(1.0, _ROWS / picture.shape[0])
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)

    def step(one: int, other: int) -> float:
        return float(np.abs(small[:, one] - small[:, other]).mean())

    rows = small.std(axis=1).mean(axis=-1)
    columns = small.std(axis=0).mean(axis=-1)
    # Edges in one color, as of a visor or a letterbox, continue each other without being neighbors.
    plain = min(columns[0], columns[-1]) < _MAX_POLE * np.median(columns)
    joined = not plain and step(0, -1) <= _MAX_STEP * (step(0, 1) + step(-1, -2)) / 2 + _LEVELS
    return joined and min(rows[0], rows[-1]) <= _MAX_POLE * np.median(rows) + _LEVELS
