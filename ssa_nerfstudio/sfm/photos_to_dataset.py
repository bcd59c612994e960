"""From photos or videos to a nerfstudio dataset."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import PIL.Image

from ssa_nerfstudio._system.pycolmap_import import import_pycolmap
from ssa_nerfstudio.cameras.groups import same_intrinsics
from ssa_nerfstudio.cameras.panorama import cut
from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.sfm.detected_mask import CameraEvidence
from ssa_nerfstudio.sfm.existing_model import ExistingModel
from ssa_nerfstudio.sfm.feature_mask import widened
from ssa_nerfstudio.sfm.fisheye_guess import fisheye_guess
from ssa_nerfstudio.sfm.flat_field import MIN_PHOTOS, write_flattened
from ssa_nerfstudio.sfm.ingest import Photo, expected_count, ingest
from ssa_nerfstudio.sfm.model_repair import Repair
from ssa_nerfstudio.sfm.nerfstudio_dataset import MASK, write_dataset
from ssa_nerfstudio.sfm.progress_display import ProgressCallback
from ssa_nerfstudio.sfm.reconstruction import KEPT, Mount, Pass, SfmSettings, reconstruct
from ssa_nerfstudio.sfm.registration import PassRegistration, check_lenses, check_registrations, registrations
from ssa_nerfstudio.sfm.work_folder import resumable_work

if TYPE_CHECKING:
    import pycolmap

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Summary:
    """What processing found."""

    passes: tuple[PassRegistration, ...]
    """Registration of each camera's training photos, then of the clean pass."""
    points: int
    """Number of 3D points."""
    reprojection_error: float
    """Mean over the points' observations, pixels of the photos."""
    masked: float
    """Share of the training photos' frames that is masked, mean over the cameras, in [0, 1]."""
    repair: Repair | None = None
    """What became of the model that there was."""


def process(
    sources: Sequence[Source],
    output: Path,
    mask: np.ndarray | None = None,
    detect: bool = False,
    clean: Source | None = None,
    frames: int = 200,
    min_registered: float = 0.5,
    settings: SfmSettings | None = None,
    known: ExistingModel | None = None,
    on_progress: ProgressCallback = lambda part, done, total: None,
) -> Summary:
    """Write a nerfstudio dataset: images/, transforms.json, sparse_pc.ply and COLMAP's model in colmap/sparse/0.

    All are mapped together, each with a camera of its own. Where there is a clean pass, it tests and all others train.
    The output appears only when it is complete. Until then work lies in `.NAME.work`
    beside it, from which the next run with the same arguments continues.

    Args:
        sources: the cameras to train on.
        output: folder to make.
        mask: bool [height, width] for the only source, True where features may lie; of equirectangular photos, whole.
        detect: whether to detect an opaque artifact of each camera and mask it, where no mask is given.
        clean: a pass of the same scene without the artifact, to test on.
        frames: number of frames to take from videos of a camera, at least 1.
        min_registered: required share of registered photos of each pass, in [0, 1].
        settings: settings of structure from motion.
        known: a model of the photos of `sources`, which are its own; the photos are registered to what holds of it.
        on_progress: called with how far each part is.

    Raises:
        InputError: a photo is broken, the mask keeps the artifact alone, too few photos were registered, or the output
            cannot be written.
    """
    settings = settings or SfmSettings()
    cameras = [camera for source in sources for camera in source.cameras]
    train, sources = len(cameras), [*sources, *([clean] if clean is not None else [])]
    names = [camera.name for source in sources for camera in source.cameras]
    masks: list[np.ndarray | None] = [None] * train
    if mask is not None:
        masks = [mask if face is None else cut(mask.astype(np.float32), face) > 0.5 for _, face in cameras]
        masks = [widened(each) for each in masks if each is not None]
    with resumable_work(output) as work:
        inputs = [(*(camera.name for camera in source.cameras), source.fingerprint(), frames) for source in sources]
        dataset = work.subfolder("dataset", inputs)
        photos = _ingest_all(sources, dataset, frames, on_progress)
        evidence = [_evidence(dataset, each, on_progress) for each in photos[:train]]
        if mask is not None:
            for used, each in zip(masks, evidence, strict=True):
                assert used is not None
                each.check_mask_polarity(used)
        elif detect:
            masks = [None if (found := each.opaque_mask()) is None else widened(found) for each in evidence]
        poses = {} if known is None else _poses(known, photos)
        start = [known and known.lenses, *((name, pose.tolist()) for name, pose in poses.items())]
        asked = [inputs, [*map(_digest, masks)], asdict(settings) | {"threads": None}, start]
        motion = work.subfolder("motion", asked)
        passes = _passes(sources, photos, dataset / "images", motion, masks, evidence, settings, on_progress)
        if known is not None:
            passes[:train] = [replace(each, lens=lens) for each, lens in zip(passes, known.lenses, strict=False)]
        found = reconstruct(dataset / "images", passes, motion, settings, on_progress, poses)
        model = found and _load(found)
        registered = registrations(names, photos, model)
        try:
            detected = "detection" if any(each is not None for each in masks) else None
            check_registrations(registered, min_registered, "user" if mask is not None else detected)
        except InputError as error:
            work.keep_after_error = True
            remedy = (
                f"{error.remedy}; the same command with a lower --min-registered continues (its work is in {work.path})"
            )
            raise InputError(error.problem, remedy) from error
        assert model is not None
        check_lenses(names, model)
        files = [photo for each in photos for photo in each]
        tests = {photo.name for each in photos[train:] for photo in each}
        used = [Path(each.mask) for each in passes if each.mask]
        write_dataset(dataset, files, tests, model, used, sources[0] if sources[0].faces else None)
        _warn_of_equal_cameras(model, names[:train])
        repair = None
        if known is not None:
            kept = {*json.loads((motion / KEPT).read_text(encoding="utf-8"))}
            now = {image.name for image in model.images.values() if image.has_pose}
            repair = Repair.of(known, photos[:train], masks, kept, now)
        dataset.rename(output)
        work.remove()
    masked = float(np.mean([0.0 if mask is None else 1 - mask.mean() for mask in masks]))
    return Summary(registered, model.num_points3D(), model.compute_mean_reprojection_error(), masked, repair)


def _poses(known: ExistingModel, photos: Sequence[Sequence[Photo]]) -> dict[str, np.ndarray]:
    """The poses of the model by the names that the photos have in the dataset."""
    files = [file for source in known.sources for file in source.photos]
    names = [photo.name for each in photos[: len(known.sources)] for photo in each]
    return {n: known.photos[file].pose for n, file in zip(names, files, strict=True) if file in known.photos}


def _warn_of_equal_cameras(model: pycolmap.Reconstruction, names: Sequence[str]) -> None:
    """Training tells cameras apart by their frames and intrinsics alone."""
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    lenses = {number: np.array([c.width, c.height, *c.params[:4]]) for number, c in model.cameras.items()}
    for one, other in combinations(sorted(used & {*range(1, len(names) + 1)}), 2):
        if (lenses[one][:2] == lenses[other][:2]).all() and same_intrinsics(lenses[one], lenses[other]):
            _LOG.warning(
                f"the cameras {names[one - 1]} and {names[other - 1]} have nearly the same intrinsics, and training "
                "takes them for one with one overlay; where their artifacts differ, process and train them one by one"
            )


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
    photos = [camera for source in sources for camera in ingest(source, dataset, frames, advance)]
    on_progress("photos", total, total)
    return photos


def _evidence(dataset: Path, photos: Sequence[Photo], on_progress: ProgressCallback) -> CameraEvidence:
    files = [dataset / "images" / photo.name for photo in photos]
    return CameraEvidence(files, lambda done: on_progress("detection", done, len(files)))


def _passes(
    sources: Sequence[Source],
    photos: Sequence[Sequence[Photo]],
    images: Path,
    folder: Path,
    masks: Sequence[np.ndarray | None],
    evidence: Sequence[CameraEvidence],
    settings: SfmSettings,
    on_progress: ProgressCallback,
) -> list[Pass]:
    """Where features of each pass are extracted: those that train have flattened copies, and masks where there are."""
    passes = []
    cameras = [(source, camera) for source in sources for camera in source.cameras]
    for number, ((source, camera), each) in enumerate(zip(cameras, photos, strict=True)):
        names = [photo.name for photo in each]
        mount, lens = None, None
        if (face := camera.face) is not None:
            mount = Mount(source.name, f"{camera.name}_", face.from_panorama.tolist())
            lens = [face.focal, face.focal, face.size / 2, face.size / 2, 0.0, 0.0, 0.0, 0.0]
        elif settings.camera_model == "OPENCV_FISHEYE":
            lens = fisheye_guess([images / name for name in names])
        if number >= len(masks):
            passes.append(Pass(names, str(images), None, lens, mount))
            continue
        copies = _flatten(names, images, folder / "flat", evidence[number], settings, on_progress)
        file = None
        if (mask := masks[number]) is not None:
            file = str(folder / (MASK if len(masks) == 1 else f"{Path(MASK).stem}_{camera.name}.png"))
            PIL.Image.fromarray(mask).save(file)
        passes.append(Pass(names, str(copies), file, lens, mount))
    return passes


def _flatten(
    names: list[str],
    images: Path,
    folder: Path,
    evidence: CameraEvidence,
    settings: SfmSettings,
    on_progress: ProgressCallback,
) -> Path:
    """Folder of the photos without their static factor; `images` where they have none or settings disable it."""
    if not settings.flatten or len(names) < MIN_PHOTOS:
        return images
    if not (folder.is_dir() and all((folder / name).is_file() for name in names)):
        on_progress("artifact", 0, len(names))
        files = [images / name for name in names]
        # A walk straight ahead has static edges of its own, which belong to the scene.
        stretches = evidence.unchanged_stretches()
        size = settings.max_image_size
        if not write_flattened(files, stretches, folder, size, lambda done: on_progress("artifact", done, len(names))):
            on_progress("artifact", len(names), len(names))
            return images
    return folder


def _load(model: Path) -> pycolmap.Reconstruction:
    return import_pycolmap().Reconstruction(model)


def _digest(mask: np.ndarray | None) -> str | None:
    return None if mask is None else hashlib.sha256(str(mask.shape).encode() + np.packbits(mask).tobytes()).hexdigest()
