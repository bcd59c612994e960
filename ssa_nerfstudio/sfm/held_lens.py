"""Mapping with the lens held at a guess first, where mapping with a free one leaves photos out or finds no real lens.

COLMAP frees the focal lengths and the distortion from the first two photos on. Two photos of a walk straight ahead, or
with few matches, do not determine them: the lens becomes absurd, and no third photo fits. With the lens held at a guess
the same matches give poses of all photos, and these determine the lens.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pycolmap

from ssa_nerfstudio.sfm.registration import MIN_REGISTERED, has_real_lenses

_GUESSES = (1.2, 0.85, 0.6, 0.42)
"""Focal lengths to hold, in longer sides of the photo: 45 degrees, which is COLMAP's guess, to 100, by roots of 2."""


def most_registered(models: Mapping[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    """The model with most photos; None where there is none."""
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def map_with_held_lens(
    database: Path,
    images: Path,
    folder: Path,
    options: Callable[[], pycolmap.IncrementalPipelineOptions],
    guessed: Sequence[int],
    found: pycolmap.Reconstruction | None,
    on_photo: Callable[[], None],
) -> pycolmap.Reconstruction | None:
    """Map with the lenses held, then free them, and once again from what was found; from several guesses.

    Args:
        database: of features and matches; not changed.
        images: folder of the photos.
        folder: to work in; made, and removed at the end.
        options: makes options of the mapping; their constant cameras are never freed.
        guessed: numbers of the cameras whose lens is guessed; those of the others start as they are in the database.
        found: what mapping with free lenses has found; its lenses are tried, too.
        on_photo: called after every photo.

    Returns:
        Of the models that have nine tenths of the photos of the largest one, that with the smallest reprojection error,
        those with real lenses first; None where nothing is found.
    """
    folder.mkdir()
    own = Path(shutil.copy(database, folder / "database.db"))

    def attempt(name: str) -> pycolmap.Reconstruction | None:
        held, freed = folder / f"{name}_held", folder / f"{name}_freed"
        for made in (held, freed):
            made.mkdir()
        settings = options()
        with pycolmap.Database.open(own) as opened:
            settings.constant_cameras = {camera.camera_id for camera in opened.read_all_cameras()}
        start = most_registered(pycolmap.incremental_mapping(own, images, held, settings, next_image_callback=on_photo))
        if start is None:
            return None
        start.write_binary(held)
        return most_registered(pycolmap.incremental_mapping(own, images, freed, options(), input_path=held))

    try:
        models = []
        for guess in _GUESSES if guessed else _GUESSES[:1]:
            _guess(own, guessed, guess)
            models.append(attempt(f"{guess}"))
        if found is not None:
            _take_lenses(own, found)
            models.append(attempt("found"))
        if (best := _best(models)) is not None:
            _take_lenses(own, best)
            best = _best([best, attempt("again")])
        return best
    finally:
        shutil.rmtree(folder)


def _guess(database: Path, numbers: Sequence[int], guess: float) -> None:
    with pycolmap.Database.open(database) as opened:
        for number in numbers:
            camera = opened.read_camera(number)
            focal = guess * max(camera.width, camera.height)
            camera.params = [focal, focal, camera.width / 2, camera.height / 2, 0.0, 0.0, 0.0, 0.0]
            opened.update_camera(camera)


def _take_lenses(database: Path, model: pycolmap.Reconstruction) -> None:
    with pycolmap.Database.open(database) as opened:
        for camera in model.cameras.values():
            opened.update_camera(camera)


def _best(models: Sequence[pycolmap.Reconstruction | None]) -> pycolmap.Reconstruction | None:
    mapped = [model for model in models if model is not None]
    most = max((model.num_reg_images() for model in mapped), default=0)
    complete = [model for model in mapped if model.num_reg_images() >= MIN_REGISTERED * most]
    return min(
        complete, key=lambda model: (not has_real_lenses(model), model.compute_mean_reprojection_error()), default=None
    )
