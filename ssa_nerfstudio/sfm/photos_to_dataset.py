"""From photos or videos to a nerfstudio dataset."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import PIL.Image
from rich.console import Console

from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.sfm.detected_mask import detected_mask
from ssa_nerfstudio.sfm.feature_mask import widened
from ssa_nerfstudio.sfm.flat_field import MIN_PHOTOS, static_factor, write_flattened
from ssa_nerfstudio.sfm.ingest import Photo, expected_count, ingest
from ssa_nerfstudio.sfm.nerfstudio_dataset import MASK, write_dataset
from ssa_nerfstudio.sfm.progress_display import ProgressCallback, progress_display
from ssa_nerfstudio.sfm.reconstruction import Pass, SfmSettings, reconstruct
from ssa_nerfstudio.sfm.registration import PassRegistration, check_registrations, registrations
from ssa_nerfstudio.sfm.work_folder import resumable_work

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class Summary:
    """What processing found."""

    passes: tuple[PassRegistration, ...]
    """Registration of each pass, the training photos first."""
    points: int
    """Number of 3D points."""
    reprojection_error: float
    """Mean over the points' observations, pixels of the photos."""
    masked: float
    """Share of the first pass's frame that is masked, in [0, 1]."""


def process(
    sources: Sequence[Source],
    output: Path,
    mask: np.ndarray | None = None,
    detect: bool = False,
    frames: int = 200,
    min_registered: float = 0.5,
    settings: SfmSettings | None = None,
    console: Console | None = None,
) -> Summary:
    """Write a nerfstudio dataset: images/, transforms.json, sparse_pc.ply and COLMAP's model in colmap/sparse/0.

    All passes are mapped together, each with a camera of its own. Where there are two, the photos of the first train
    and those of the second test. The output appears only when it is complete. Until then work lies in `.NAME.work`
    beside it, from which the next run with the same arguments continues.

    Args:
        sources: the passes, one or two, the one to train on first.
        output: folder to make.
        mask: bool [height, width] for the first pass, True where features may lie.
        detect: whether to detect an opaque artifact in the first pass and mask it, where no mask is given.
        frames: number of frames to take from a pass of videos, at least 1.
        min_registered: required share of registered photos of each pass, in [0, 1].
        settings: settings of structure from motion.
        console: where progress is shown.

    Raises:
        InputError: a photo is broken, too few were registered, or the output cannot be written.
    """
    settings = settings or SfmSettings()
    mask = None if mask is None else widened(mask)
    with resumable_work(output) as work, progress_display(console or Console()) as on_progress:
        inputs = [(source.name, source.fingerprint(), frames) for source in sources]
        dataset = work.subfolder("dataset", inputs)
        photos = _ingest_all(sources, dataset, frames, on_progress)
        if detect and mask is None:
            files = [dataset / "images" / photo.name for photo in photos[0]]
            mask = detected_mask(files, lambda done: on_progress("detection", done, len(files)))
            mask = None if mask is None else widened(mask)
        motion = work.subfolder("motion", [inputs, _digest(mask), asdict(settings) | {"threads": None}])
        passes = _passes(photos, dataset / "images", motion, mask, settings, on_progress)
        found = reconstruct(dataset / "images", passes, motion, settings, on_progress)
        model = found and _load(found)
        registered = registrations([source.name for source in sources], photos, model)
        try:
            check_registrations(registered, min_registered, masked=mask is not None)
        except InputError as error:
            work.keep_after_error = True
            remedy = f"{error.remedy}; a run that requires fewer continues from the work in {work.path}"
            raise InputError(error.problem, remedy) from error
        assert model is not None
        write_dataset(dataset, photos, model, mask)
        dataset.rename(output)
        work.remove()
    masked = 0.0 if mask is None else float(1 - mask.mean())
    return Summary(registered, model.num_points3D(), model.compute_mean_reprojection_error(), masked)


def _ingest_all(
    sources: Sequence[Source], dataset: Path, frames: int, on_progress: ProgressCallback
) -> list[list[Photo]]:
    total = sum(expected_count(source, frames) for source in sources)
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        on_progress("photos", min(done, total), total)

    on_progress("photos", 0, total)
    photos = [ingest(source, dataset, frames, advance) for source in sources]
    on_progress("photos", total, total)
    return photos


def _passes(
    photos: Sequence[Sequence[Photo]],
    images: Path,
    folder: Path,
    mask: np.ndarray | None,
    settings: SfmSettings,
    on_progress: ProgressCallback,
) -> list[Pass]:
    """Where features of each pass are extracted: the first pass has a mask and flattened copies, if there are any."""
    passes = [Pass([photo.name for photo in each], str(images)) for each in photos]
    if mask is not None:
        PIL.Image.fromarray(mask).save(folder / MASK)
    names = passes[0].photos
    copies = _flatten(names, images, folder / "flat", settings, on_progress)
    return [Pass(names, str(copies), None if mask is None else str(folder / MASK)), *passes[1:]]


def _flatten(
    names: list[str], images: Path, folder: Path, settings: SfmSettings, on_progress: ProgressCallback
) -> Path:
    """Folder of the photos without their static factor; `images` where they have none or settings disable it."""
    if not settings.flatten or len(names) < MIN_PHOTOS:
        return images
    done = sum((folder / name).is_file() for name in names) if folder.is_dir() else 0
    if done < len(names):
        on_progress("artifact", 0, len(names))
        factor = static_factor([images / name for name in names], settings.max_image_size)
        if factor is None:
            on_progress("artifact", len(names), len(names))
            return images
        folder.mkdir(exist_ok=True)
        for number, name in enumerate(names, 1):
            write_flattened(images / name, folder / name, factor)
            on_progress("artifact", number, len(names))
    return folder


def _load(model: Path) -> pycolmap.Reconstruction:
    # Late, because COLMAP replaces the signal handlers; after PIL, because saving a PNG would abort otherwise.
    import pycolmap

    return pycolmap.Reconstruction(model)


def _digest(mask: np.ndarray | None) -> str | None:
    return None if mask is None else hashlib.sha256(str(mask.shape).encode() + np.packbits(mask).tobytes()).hexdigest()
