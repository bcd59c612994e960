"""Detection on photos as they lie on the disk: statistics and verdict of each camera, and the files that show them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.progress import track

from ssa_nerfstudio._system.ordered_map import ordered_map
from ssa_nerfstudio.cameras.groups import group_frames
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.data.sources import Source, read_source
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.detection import DRAWS, EVIDENCE_NEEDED, Detection, detect
from ssa_nerfstudio.evidence.statistics import accumulate

MIN_PHOTOS = 2
"""What stays the same in all photos takes more than one to see."""


@dataclass(frozen=True)
class Camera:
    """Photos of one camera."""

    name: str
    """For messages and folders: camera-1, ..."""
    count: int
    """How many there are, about."""
    photos: Callable[[int], Iterator[np.ndarray]]
    """Decodes them in their order, so many at once: uint8 [H, W, 3]."""


def cameras_of(data: Path, frames: int) -> list[Camera]:
    """The cameras of a nerfstudio dataset (its training photos), of a folder of photos or videos, or of one video.

    Args:
        data: where they are; poses are not needed and not read.
        frames: to take from videos.

    Raises:
        InputError: nothing usable is there, or too few photos.
    """
    if data.suffix == ".json" or (data / "transforms.json").is_file():
        return _of_dataset(Dataset.read(data, eval_interval=8), data)
    source = read_source(data, "frame", min_photos=MIN_PHOTOS)
    if source.videos:
        return [Camera("camera-1", frames, lambda _: _frames(source, frames))]
    return [
        Camera("camera-1", len(source.photos), partial(ordered_map, partial(read_photo, upright=True), source.photos))
    ]


def detect_camera(camera: Camera, threads: int, console: Console | None = None, draws: int = DRAWS) -> Detection:
    """Decode a camera's photos once and test what they have in common; memory does not depend on their number.

    Args:
        camera: whose photos.
        threads: photos decoded at once.
        console: takes the progress bar.
        draws: shifted captures to compare with.

    Raises:
        InputError: a photo cannot be decoded.
    """
    photos = track(
        camera.photos(threads), camera.name, camera.count, transient=True, console=console, disable=console is None
    )
    return detect(accumulate((torch.from_numpy(photo), None) for photo in photos), draws)


def detect_artifacts(data: Path | str, frames: int = 200, threads: int | None = None) -> dict[str, Detection]:
    """Test whether photos carry a static artifact; poses are not needed.

    Args:
        data: a nerfstudio dataset (its training photos), a folder of photos or videos, or one video.
        frames: frames to take from videos.
        threads: photos decoded at once; one per core where None.

    Returns:
        One detection per camera, by name: `camera-1`, ...

    Raises:
        InputError: nothing usable is there, too few photos, or one that cannot be decoded.
    """
    threads = threads or os.cpu_count() or 1
    return {camera.name: detect_camera(camera, threads) for camera in cameras_of(Path(data), frames)}


def write_detections(folder: Path, found: dict[str, Detection]) -> None:
    """Write evidence.png, mask_nerfstudio.png and mask_colmap.png, for several cameras in a folder each.

    nerfstudio (mask_path) and COLMAP (camera_mask_path) both ignore black, so the two masks are the same: black where
    the artifact is, white where the scene is, in the photos' raw frame. The names are there so that nobody has to ask.

    Args:
        folder: an empty one.
        found: by the camera's name.
    """
    for name, detection in found.items():
        target = folder / name if len(found) > 1 else folder
        target.mkdir(exist_ok=True)
        Image.fromarray(_evidence_picture(detection)).save(target / "evidence.png")
        mask = Image.fromarray((~detection.mask).numpy().astype(np.uint8) * 255)
        for file in ("mask_nerfstudio.png", "mask_colmap.png"):
            mask.save(target / file)


def as_json(found: dict[str, Detection]) -> str:
    """verdict, coverage, p_value, views and more of every camera."""
    groups = [
        {
            "name": name,
            "verdict": d.verdict,
            "coverage": d.coverage,
            "p_value": d.p_value,
            "p_interval": d.p_interval,
            "views": d.views,
            "shares": d.shares,
            "null_shares": d.null_shares,
            "width": d.mask.shape[1],
            "height": d.mask.shape[0],
        }
        for name, d in found.items()
    ]
    return json.dumps({"groups": groups}, indent=2) + "\n"


def _of_dataset(dataset: Dataset, data: Path) -> list[Camera]:
    views = [view for view in dataset.views if view.role == "train"]
    lenses = [(v.lens.width, v.lens.height, v.lens.fx, v.lens.fy, v.lens.cx, v.lens.cy) for v in views]
    groups = group_frames(np.array(lenses, dtype=np.float64))

    cameras = []
    for group in range(max(groups) + 1):
        members = [view for view, at in zip(views, groups, strict=True) if at == group]
        if len(members) < MIN_PHOTOS:
            raise InputError(
                f"{data}: {members[0].path} is the only photo of its camera",
                f"what stays the same takes {MIN_PHOTOS} to see: add photos or take it out",
            )
        cameras.append(Camera(f"camera-{group + 1}", len(members), partial(ordered_map, dataset.read_photo, members)))
    return cameras


def _frames(source: Source, frames: int) -> Iterator[np.ndarray]:
    for _, _, picture in source.video_frames(frames):
        yield cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def _evidence_picture(detection: Detection) -> np.ndarray:
    """Evidence in colors, brightest at twice what is needed; uint8 [h, w, 3]."""
    level = (detection.evidence.cpu().numpy() / (2 * EVIDENCE_NEEDED[0])).clip(0, 1)
    colored = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return cv2.cvtColor(colored, cv2.COLOR_BGR2RGB)
