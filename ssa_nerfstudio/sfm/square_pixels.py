"""Pixels are square while photos are mapped, and after that unless the photos tell otherwise.

A camera that turns about the vertical only, as on a walk or a drive, sees the same in a scene that is twice as high
with half the vertical focal length. Two focal lengths are then not determined, and errors of the features choose their
ratio. With one focal length for both axes the same photos determine the lens.
"""

from __future__ import annotations

from pathlib import Path

import pycolmap

_MODEL = "RADIAL"
"""COLMAP's model of the lens with one focal length: f, cx, cy, k1, k2."""
_MAX_SHARE = 0.95
"""Reprojection error with free focal lengths, in errors with equal ones, up to which pixels are taken for oblong.
Measured: 0.997 to 1.000 of square pixels, 0.89 where photos were stretched by a tenth."""


def hold(database: Path) -> None:
    """Give all cameras, of model OPENCV and not estimated yet, one focal length."""
    _set_model(database, _MODEL)


def free(database: Path) -> None:
    """Undo `hold`."""
    _set_model(database, "OPENCV")


def _set_model(database: Path, name: str) -> None:
    with pycolmap.Database.open(database) as opened:
        for old in opened.read_all_cameras():
            focal = old.mean_focal_length()
            new = pycolmap.Camera.create_from_model_name(old.camera_id, name, focal, old.width, old.height)
            new.has_prior_focal_length = old.has_prior_focal_length
            opened.update_camera(new)


def are_held(model: pycolmap.Reconstruction) -> bool:
    """Whether all cameras have one focal length."""
    return all(camera.model.name == _MODEL for camera in model.cameras.values())


def with_opencv_lenses(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model with the same lenses, those of one focal length as OPENCV ones."""
    result = pycolmap.Reconstruction(model)
    for camera in result.cameras.values():
        if camera.model.name == _MODEL:
            focal, cx, cy, k1, k2 = camera.params
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [focal, focal, cx, cy, k1, k2, 0.0, 0.0]
    return result


def refined(model: pycolmap.Reconstruction, threads: int) -> pycolmap.Reconstruction:
    """Refine OPENCV lenses, poses and points; focal lengths become unequal only where photos fit much better so.

    Args:
        model: with `with_opencv_lenses`; not changed.
        threads: number of them; -1: one per core.
    """
    square = _adjusted(model, threads, free=False)
    oblong = _adjusted(square, threads, free=True)
    errors = [each.compute_mean_reprojection_error() for each in (square, oblong)]
    return oblong if errors[1] <= _MAX_SHARE * errors[0] else square


def _adjusted(model: pycolmap.Reconstruction, threads: int, free: bool) -> pycolmap.Reconstruction:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = free
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    result = pycolmap.Reconstruction(model)
    pycolmap.bundle_adjustment(result, options)
    result.update_point_3d_errors()
    return result
