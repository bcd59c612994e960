"""From photos or videos to a nerfstudio dataset."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ssa_nerfstudio._system.pycolmap_import import import_pycolmap
from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.cameras.panorama import cut
from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.sfm.detected_mask import FoundArtifact
from ssa_nerfstudio.sfm.existing_model import ExistingModel
from ssa_nerfstudio.sfm.feature_mask import widened
from ssa_nerfstudio.sfm.feature_passes import camera_evidence, feature_passes
from ssa_nerfstudio.sfm.ingest import Photo, expected_count, ingest
from ssa_nerfstudio.sfm.model_repair import Repair
from ssa_nerfstudio.sfm.nerfstudio_dataset import write_dataset
from ssa_nerfstudio.sfm.progress_display import ProgressCallback
from ssa_nerfstudio.sfm.reconstruction import KEPT, TORN, Pass, SfmSettings, reconstruct
from ssa_nerfstudio.sfm.registration import (
    PassRegistration,
    better,
    check_lenses,
    check_registrations,
    is_complete,
    registrations,
    warn_of_equal_cameras,
    warn_of_false_joins,
)
from ssa_nerfstudio.sfm.work_folder import resumable_work

if TYPE_CHECKING:
    import pycolmap

SUMMARY = Path("colmap", "summary.json")
"""File of a dataset's `Summary`."""


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
    unmasked: bool = False
    """Whether an artifact that was detected is not masked after all, because more photos register so."""

    @staticmethod
    def read(dataset: Path) -> Summary:
        """Read that of a dataset that `process` has made.

        Raises:
            OSError, ValueError, TypeError, LookupError: it has none that can be read.
        """
        values = _with_tuples(json.loads(read_text(dataset / SUMMARY)))
        passes = tuple(PassRegistration(**each) for each in values["passes"])
        repair = values["repair"] and Repair(**values["repair"])
        return Summary(**{**values, "passes": passes, "repair": repair})


class _Mapped(NamedTuple):
    """What structure from motion makes of the photos with some masks."""

    folder: Path
    passes: list[Pass]
    masks: Sequence[np.ndarray | None]
    model: pycolmap.Reconstruction | None


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
    found: Sequence[FoundArtifact] | None = None,
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
        detect: whether to detect an opaque artifact of each camera and mask it, where no mask is given. Where too few
            photos register then, poses are found without masks, too.
        clean: a pass of the same scene without the artifact, to test on.
        frames: number of frames to take from videos of a camera, at least 1.
        min_registered: required share of registered photos of each pass, in [0, 1].
        settings: settings of structure from motion.
        known: a model of the photos of `sources`, which are its own; the photos are registered to what holds of it.
        found: what was detected in the photos of each source, which is then not repeated; of no use where `known` has
            sources of its own. Faces of equirectangular photos are tested one by one in any case.
        on_progress: called with how far each part is.

    Raises:
        InputError: a photo is broken, the mask keeps the artifact alone, too few photos were registered, or the output
            cannot be written.
    """
    settings = settings or SfmSettings()
    cameras = [camera for source in sources for camera in source.cameras]
    train, sources = len(cameras), [*sources, *([clean] if clean is not None else [])]
    names = [camera.name for source in sources for camera in source.cameras]
    masks: Sequence[np.ndarray | None] = [None] * train
    if mask is not None:
        masks = [mask if face is None else cut(mask.astype(np.float32), face) > 0.5 for _, face in cameras]
        masks = [widened(each) for each in masks if each is not None]
    with resumable_work(output) as work:
        inputs = [(*(camera.name for camera in source.cameras), source.fingerprint(), frames) for source in sources]
        dataset = work.subfolder("dataset", inputs)
        photos = _ingest_all(sources, dataset, frames, on_progress)
        known_of = [] if found is None or known is not None else found
        evidence = camera_evidence(dataset, sources, photos[:train], known_of, on_progress)
        if mask is not None:
            for used, each in zip(masks, evidence, strict=True):
                assert used is not None
                each.check_mask_polarity(used)
        elif detect:
            masks = [None if (used := each.opaque_mask()) is None else widened(used) for each in evidence]
        poses = {} if known is None else _poses(known, photos)
        start = [known and known.lenses, *((name, pose.tolist()) for name, pose in poses.items())]

        def mapped(masks: Sequence[np.ndarray | None], folder: str) -> _Mapped:
            asked = [inputs, [*map(_digest, masks)], asdict(settings) | {"threads": None}, start]
            motion = work.subfolder(folder, asked)
            passes = feature_passes(sources, photos, dataset / "images", motion, masks, evidence, settings, on_progress)
            if known is not None:
                passes[:train] = [replace(each, lens=lens) for each, lens in zip(passes, known.lenses, strict=False)]
            model = reconstruct(dataset / "images", passes, motion, settings, on_progress, poses)
            return _Mapped(motion, passes, masks, model and _load(model))

        outcome, unmasked = mapped(masks, "motion"), False
        detected = mask is None and any(each is not None for each in masks)
        if detected and known is None and not is_complete(outcome.model, sum(map(len, photos))):
            # Masks that hide most of the scene do more harm than features on the artifact.
            without = mapped([None] * train, "motion_without_masks")
            unmasked = better(outcome.model, without.model) is not outcome.model
            outcome = without if unmasked else outcome
        motion, passes, masks, model = outcome
        registered = registrations(names, photos, model)
        try:
            masked_by = "user" if mask is not None else "detection" if detected else None
            check_registrations(registered, min_registered, masked_by)
        except InputError as error:
            if any(each.stands_still() for each in evidence):
                problem = f"{error.problem}: nothing in them moves, as in copies of one photo or from a tripod"
                raise InputError(problem, "take photos from several places") from error
            if not min_registered:
                raise  # no other share helps
            work.keep_after_error = True
            remedy = (
                f"{error.remedy}; the same command with a lower --min-registered continues (its work is in {work.path})"
            )
            raise InputError(error.problem, remedy) from error
        assert model is not None
        check_lenses(names, model)
        files = [photo for each in photos for photo in each]
        warn_of_false_joins(json.loads(read_text(motion / TORN)), {photo.name: photo.source for photo in files})
        tests = {photo.name for each in photos[train:] for photo in each}
        used = [Path(each.mask) for each in passes if each.mask]
        write_dataset(dataset, files, tests, model, used, sources[0] if sources[0].faces else None)
        warn_of_equal_cameras(model, names[:train])
        repair = None
        if known is not None:
            kept = {*json.loads(read_text(motion / KEPT))}
            now = {image.name for image in model.images.values() if image.has_pose}
            repair = Repair.of(known, photos[:train], masks, kept, now)
        masked = float(np.mean([0.0 if mask is None else 1 - mask.mean() for mask in masks]))
        error = model.compute_mean_reprojection_error()
        summary = Summary(registered, model.num_points3D(), error, masked, repair, unmasked)
        (dataset / SUMMARY).write_text(json.dumps(asdict(summary), indent=1) + "\n", encoding="utf-8")
        dataset.rename(output)
        work.remove()
    return summary


def _with_tuples(value: Any) -> Any:
    """JSON values whose lists are tuples."""
    if isinstance(value, dict):
        return {key: _with_tuples(each) for key, each in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


def _poses(known: ExistingModel, photos: Sequence[Sequence[Photo]]) -> dict[str, np.ndarray]:
    """The poses of the model by the names that the photos have in the dataset."""
    files = [file for source in known.sources for file in source.photos]
    names = [photo.name for each in photos[: len(known.sources)] for photo in each]
    return {n: known.photos[file].pose for n, file in zip(names, files, strict=True) if file in known.photos}


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


def _load(model: Path) -> pycolmap.Reconstruction:
    return import_pycolmap().Reconstruction(model)


def _digest(mask: np.ndarray | None) -> str | None:
    return None if mask is None else hashlib.sha256(str(mask.shape).encode() + np.packbits(mask).tobytes()).hexdigest()
