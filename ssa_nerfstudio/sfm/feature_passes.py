"""What structure from motion looks at: copies of the photos without the static factor, and masks of the artifact."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import PIL.Image

from ssa_nerfstudio.data.sources import Source
from ssa_nerfstudio.sfm.detected_mask import CameraEvidence, FoundArtifact
from ssa_nerfstudio.sfm.fisheye_guess import fisheye_guess
from ssa_nerfstudio.sfm.flat_field import MIN_PHOTOS, write_flattened
from ssa_nerfstudio.sfm.ingest import Photo
from ssa_nerfstudio.sfm.nerfstudio_dataset import MASK
from ssa_nerfstudio.sfm.progress_display import ProgressCallback
from ssa_nerfstudio.sfm.reconstruction import Mount, Pass, SfmSettings


def camera_evidence(
    dataset: Path,
    sources: Sequence[Source],
    photos: Sequence[Sequence[Photo]],
    found: Sequence[FoundArtifact],
    on_progress: ProgressCallback,
) -> list[CameraEvidence]:
    """What detection says of the photos that train.

    Args:
        dataset: folder that has the photos.
        sources: all passes, those that train first.
        photos: of each camera that trains.
        found: what is known of each source that trains; empty where nothing is. It is not used for faces of
            equirectangular photos: how much an artifact covers of those says little of one face.
        on_progress: called with how many photos of a camera have been read.
    """
    known = [
        None if source.faces or number >= len(found) else found[number]
        for number, source in enumerate(sources)
        for _ in source.cameras
    ]

    def evidence(photos: Sequence[Photo], found: FoundArtifact | None) -> CameraEvidence:
        files = [dataset / "images" / photo.name for photo in photos]
        return CameraEvidence(files, lambda done: on_progress("detection", done, len(files)), found)

    return [evidence(each, own) for each, own in zip(photos, known, strict=False)]


def feature_passes(
    sources: Sequence[Source],
    photos: Sequence[Sequence[Photo]],
    images: Path,
    folder: Path,
    masks: Sequence[np.ndarray | None],
    evidence: Sequence[CameraEvidence],
    settings: SfmSettings,
    on_progress: ProgressCallback,
) -> list[Pass]:
    """Where features of each pass are extracted: those that train have flattened copies, and masks where there are.

    Args:
        sources, photos: all passes, and the photos of each of their cameras.
        images: folder of the photos.
        folder: for copies and masks.
        masks, evidence: of each camera that trains.
        settings: of structure from motion.
        on_progress: called with how many photos have been flattened.
    """
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
