"""The overlays of the faces of equirectangular photos as one artifact on the sphere."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ssa_nerfstudio.cameras.lens import Lens
from ssa_nerfstudio.cameras.panorama import Face, compose
from ssa_nerfstudio.data.panorama_entry import Panorama, read_panorama
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.export.artifact_layers import ArtifactLayers


def panorama_of(data: Path) -> Panorama:
    """The equirectangular photos that a dataset was made of.

    Raises:
        InputError: it was made of others.
    """
    found = read_panorama(Transforms.read(data))
    if found is None:
        raise InputError(f"{data} was not made of equirectangular photos", "leave --equirectangular out")
    return found


def face_changes(overlays: Sequence[ArtifactLayers]) -> bool:
    """Whether a face has an overlay for each of several intervals."""
    return len({layers.camera for layers in overlays}) < len(overlays)


def panorama_layers(overlays: Sequence[ArtifactLayers], panorama: Panorama) -> ArtifactLayers:
    """Put the overlays of faces together, blended where faces overlap; a face without an overlay is clear.

    Faces are known by their focal lengths, as everywhere. T and B are blended, never colors. Directions of faces that
    were left out are clear and not known.

    Args:
        overlays: of faces, at least one, all of one size.
        panorama: the photos that the faces were cut out of.

    Raises:
        InputError: a face has several overlays.
    """
    if face_changes(overlays):
        raise InputError(
            f"the artifact changes, and one sphere shows one of it: {', '.join(each.name for each in overlays)}",
            "leave --equirectangular out, which writes every overlay of every face",
        )
    size = overlays[0].camera.width
    faces = [Face(face.name, size) for face in panorama.faces]
    by_face = {min(faces, key=lambda face, fx=layers.camera.fx: abs(face.focal - fx)): layers for layers in overlays}
    clear = np.concatenate([np.ones((size, size, 3), np.float32), np.zeros((size, size, 3), np.float32)], axis=-1)
    pictures = [
        (face, np.concatenate([by_face[face].transmittance, by_face[face].addition], -1) if face in by_face else clear)
        for face in faces
    ]
    width = 2 * max(1, round(panorama.width / 2 * size / panorama.faces[0].size))
    both, known = compose(pictures, width)
    both[~known, :3] = 1
    per_radian = width / (2 * np.pi)
    camera = Lens(width, width // 2, per_radian, per_radian, width / 2, width / 4)
    transmittance, addition = (np.ascontiguousarray(each) for each in (both[..., :3], both[..., 3:]))
    return ArtifactLayers(transmittance.clip(0, 1), addition, camera, "equirectangular", overlays[0].kind, known=known)
