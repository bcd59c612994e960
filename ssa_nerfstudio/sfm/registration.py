"""How many photos of each pass structure from motion registered, and whether they are enough."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Literal

import numpy as np

from ssa_nerfstudio.cameras.groups import same_intrinsics
from ssa_nerfstudio.cameras.lens import Lens, undistorted_lens
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.sfm.ingest import Photo

if TYPE_CHECKING:
    import pycolmap

_LOG = logging.getLogger(__name__)

MIN_REGISTERED = 0.9
"""Share of the photos below which mapping has left photos out."""
MAX_ASPECT = 1.3
"""Ratio of the focal lengths along both axes above which a lens is taken for wrong: pixels are square, and anamorphic
lenses, the only ones that squeeze pictures, begin at 1.33."""


@dataclass(frozen=True)
class PassRegistration:
    """Registration of the photos of one pass."""

    name: str
    """Name of the pass."""
    photos: int
    """Number of photos in the pass."""
    missing: tuple[str, ...]
    """Sources of the photos that were not registered."""

    @property
    def count(self) -> int:
        """Number of registered photos."""
        return self.photos - len(self.missing)

    @property
    def share(self) -> float:
        """Share of registered photos, in [0, 1]."""
        return self.count / self.photos


def registrations(
    names: Sequence[str], photos: Sequence[Sequence[Photo]], model: pycolmap.Reconstruction | None
) -> tuple[PassRegistration, ...]:
    """Count the registered photos of every pass.

    Args:
        names: names of the passes.
        photos: the photos of each.
        model: the reconstruction, or None where there is none.
    """
    images = [] if model is None else [image for image in model.images.values() if image.has_pose]
    registered = {image.name for image in images}
    return tuple(
        PassRegistration(name, len(each), tuple(photo.source for photo in each if photo.name not in registered))
        for name, each in zip(names, photos, strict=True)
    )


def check_registrations(
    passes: Sequence[PassRegistration], min_share: float, masked_by: Literal["user", "detection"] | None
) -> None:
    """Check that enough photos of every pass are registered.

    Args:
        passes: from `registrations`.
        min_share: required share of the photos of each pass, in [0, 1]; at least one photo is needed.
        masked_by: who has masked an artifact, so that another mask is no remedy; None where none is masked.

    Raises:
        InputError: a pass has fewer.
    """
    for each in passes:
        if each.share < min_share or each.count == 0:
            remedy = "take photos that overlap more"
            if masked_by is None:
                remedy = f"mask what covers part of every frame, or {remedy}"
            elif masked_by == "user":
                remedy = f"look whether the mask is black on the artifact (else --invert-mask), or {remedy}"
            raise InputError(
                f"only {each.count} of {_photos_of(each.name, passes, f'{each.photos} photos')} could be registered, "
                f"{f'{min_share:.0%} are' if min_share else 'at least one is'} required",
                remedy,
            )


def check_lenses(names: Sequence[str], model: pycolmap.Reconstruction) -> None:
    """Check that the lenses that were estimated can be undistorted, which training does first; warn of unreal ones.

    Args:
        names: of the passes, whose cameras are numbered from 1.
        model: the reconstruction; its cameras are of model OPENCV or OPENCV_FISHEYE.

    Raises:
        InputError: one cannot.
    """
    for number in map(int, sorted({image.camera_id for image in model.images.values() if image.has_pose})):
        camera = model.cameras[number]
        fx, fy, cx, cy, k1, k2, *others = map(float, camera.params)
        fisheye = camera.model.name == "OPENCV_FISHEYE"
        distortion = (k1, k2, *others, 0.0, 0.0) if fisheye else (k1, k2, 0.0, 0.0, *others)
        size, kind = (camera.width, camera.height), "fisheye" if fisheye else "perspective"
        try:
            undistorted_lens(Lens(*size, fx, fy, cx, cy, distortion, kind))
        except InputError as error:
            raise InputError(
                f"the lens that structure from motion estimates for {_photos_of(names[number - 1], names)} is none "
                f"(k1 = {k1:.2g}, k2 = {k2:.2g}): their poses are wrong",
                "take photos from more directions, that overlap more",
            ) from error
        if aspect(camera) > MAX_ASPECT:
            _LOG.warning(
                f"the lens that structure from motion estimates for {_photos_of(names[number - 1], names)} would have "
                f"pixels of {aspect(camera):.1f}:1 (focal lengths {fx:.0f} and {fy:.0f}): their poses are likely "
                "wrong; mask what covers part of every frame, or take photos from more directions"
            )


def warn_of_false_joins(torn: Sequence[Sequence[str]], sources: Mapping[str, str]) -> None:
    """Warn of photos that are at the wrong place from there on.

    Args:
        torn: names of pairs of photos that the model puts apart although they match.
        sources: for each photo the file that it was made from.
    """
    for one, other in torn:
        _LOG.warning(
            f"{sources[one]} and {sources[other]} show the same, and their poses contradict that: places that look "
            "alike are likely taken for one, and part of the poses is wrong; take more photos around there"
        )


def _photos_of(name: str, passes: Sequence[object], photos: str = "the photos") -> str:
    """The photos of a pass, which is named where there are several."""
    return f"{photos} of {name}" if len(passes) > 1 else photos


def warn_of_equal_cameras(model: pycolmap.Reconstruction, names: Sequence[str]) -> None:
    """Warn of cameras that training, which tells them apart by their frames and intrinsics alone, takes for one.

    Args:
        model: the reconstruction.
        names: of the passes to train on, whose cameras are numbered from 1.
    """
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    lenses = {number: np.array([c.width, c.height, *c.params[:4]]) for number, c in model.cameras.items()}
    for one, other in combinations(sorted(used & {*range(1, len(names) + 1)}), 2):
        if (lenses[one][:2] == lenses[other][:2]).all() and same_intrinsics(lenses[one], lenses[other]):
            _LOG.warning(
                f"the cameras {names[one - 1]} and {names[other - 1]} have nearly the same intrinsics, and training "
                "takes them for one with one overlay; where their artifacts differ, process and train them one by one"
            )


def aspect(camera: pycolmap.Camera) -> float:
    """Ratio of a camera's focal lengths along both axes, at least 1."""
    lengths = sorted((camera.focal_length_x, camera.focal_length_y))
    return lengths[1] / max(lengths[0], 1e-9)


def has_real_lenses(model: pycolmap.Reconstruction) -> bool:
    """Whether the cameras of all registered photos have pixels that are about square."""
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    return all(aspect(model.cameras[number]) <= MAX_ASPECT for number in used)


def is_complete(model: pycolmap.Reconstruction | None, photos: int) -> bool:
    """Whether mapping has left out few of so many photos, and found lenses that cameras can have."""
    return model is not None and model.num_reg_images() >= MIN_REGISTERED * photos and has_real_lenses(model)


def better(
    one: pycolmap.Reconstruction | None, other: pycolmap.Reconstruction | None
) -> pycolmap.Reconstruction | None:
    """The model with real lenses where it has nine tenths of the other's photos, else that with most of them."""
    models = [model for model in (one, other) if model is not None]
    most = max((model.num_reg_images() for model in models), default=0)

    def rank(model: pycolmap.Reconstruction) -> tuple[bool, int]:
        count = model.num_reg_images()
        return has_real_lenses(model) and count >= MIN_REGISTERED * most, count

    return max(models, key=rank, default=None)
