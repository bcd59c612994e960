"""Detection on photos and videos on disk: the cameras of a capture, their detections, and the files that show them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.progress import track

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio._system.ordered_map import ordered_map
from ssa_nerfstudio.cameras.camera_names import camera_names
from ssa_nerfstudio.cameras.groups import group_frames
from ssa_nerfstudio.cameras.intervals import capture_order
from ssa_nerfstudio.data.dataset import Dataset
from ssa_nerfstudio.data.photos import read_photo
from ssa_nerfstudio.data.sources import Source, read_sources
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.detection import DRAWS, Detection
from ssa_nerfstudio.evidence.edge_evidence import EVIDENCE_THRESHOLDS
from ssa_nerfstudio.evidence.interval_detection import detect_in_intervals

_MASKS = ("mask_nerfstudio.png", "mask_colmap.png")
FILES = {"evidence.png", *_MASKS}
"""What `write_detections` writes of each camera."""
MIN_PHOTOS = 2
"""With fewer photos of a camera, nothing can be called static."""


@dataclass(frozen=True)
class Camera:
    """The photos of one camera, as a stream."""

    name: str
    """camera_0, ..., or the name of its folder or photos; names its output's folder and its messages."""
    count: int
    """Their number; approximate for videos."""
    photos: Callable[[int], Iterator[np.ndarray]]
    """Decodes them in order, uint8 [H, W, 3] each; the argument is how many to decode at once."""


def read_cameras(data: Path, frames: int) -> list[Camera]:
    """Find the cameras of a capture, without decoding its photos; poses are not read.

    Args:
        data: a nerfstudio dataset (its training photos), a folder of photos or videos, of several cameras in a
            subfolder each or of several sizes or orientations, or one video.
        frames: frames to take from videos.

    Raises:
        InputError: no usable photos, or too few of them.
    """
    if data.suffix == ".json" or (data / "transforms.json").is_file():
        return _of_dataset(Dataset.read(data, eval_interval=8), data)
    return [_of_source(source, frames) for source in read_sources(data, "camera_0", min_photos=MIN_PHOTOS)]


def detect_camera(camera: Camera, threads: int, console: Console | None = None, draws: int = DRAWS) -> Detection:
    """Decode a camera's photos and test them; memory does not depend on their number.

    They are decoded once, or twice where the artifact changes.

    Args:
        camera: its photos.
        threads: photos decoded at once.
        console: for the progress bar; None for no bar.
        draws: shifted captures in the null distribution.

    Raises:
        InputError: a photo cannot be decoded.
    """

    def photos() -> Iterator[torch.Tensor]:
        stream, hidden = camera.photos(threads), console is None or not console.is_terminal
        stream = track(stream, camera.name, camera.count, transient=True, console=console, disable=hidden)
        return (torch.from_numpy(photo) for photo in stream)

    return detect_in_intervals(photos, draws)


def detect_artifacts(data: Path | str, frames: int = 200, threads: int | None = None) -> dict[str, Detection]:
    """Test whether photos carry a static artifact; poses are not needed.

    Args:
        data: a nerfstudio dataset (its training photos), a folder of photos or videos, or one video.
        frames: frames to take from videos.
        threads: photos decoded at once; one per core where None.

    Returns:
        One detection per camera, by name: `camera_0`, ..., or that of its folder or photos (`camera_names`).

    Raises:
        InputError: no usable photos, too few of them, or one that cannot be decoded.
    """
    threads = threads or usable_cores()
    return {camera.name: detect_camera(camera, threads) for camera in read_cameras(Path(data), frames)}


def write_detections(folder: Path, detections: dict[str, Detection]) -> None:
    """Write evidence.png, mask_nerfstudio.png and mask_colmap.png; several cameras get a folder each.

    The two masks are the same, in the photos' raw frame: black where the artifact is, white where the scene is.
    nerfstudio (mask_path) and COLMAP (camera_mask_path) both ignore black.

    Args:
        folder: an existing, empty folder.
        detections: by the camera's name.
    """
    for name, detection in detections.items():
        target = folder / name if len(detections) > 1 else folder
        target.mkdir(exist_ok=True)
        Image.fromarray(_evidence_image(detection)).save(target / "evidence.png")
        mask = Image.fromarray((~detection.mask).numpy().astype(np.uint8) * 255)
        for file in _MASKS:
            mask.save(target / file)


def detections_to_json(detections: dict[str, Detection]) -> str:
    """Serialize every camera's verdict, coverage, p-value, number of views, and shares of static edges."""
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
            "intervals": [asdict(interval) for interval in d.intervals],
        }
        for name, d in detections.items()
    ]
    return json.dumps({"groups": groups}, indent=2) + "\n"


def _of_dataset(dataset: Dataset, data: Path) -> list[Camera]:
    views = [view for view in dataset.views if view.role == "train"]
    lenses = [(v.lens.width, v.lens.height, v.lens.fx, v.lens.fy, v.lens.cx, v.lens.cy) for v in views]
    groups = group_frames(np.array(lenses, dtype=np.float64))

    cameras = []
    members_of = [[view for view, at in zip(views, groups, strict=True) if at == g] for g in range(max(groups) + 1)]
    names = camera_names([[view.path for view in members] for members in members_of])
    for name, members in zip(names, members_of, strict=True):
        members.sort(key=lambda view: capture_order(view.path))
        if len(members) < MIN_PHOTOS:
            raise InputError(
                f"{data}: {members[0].path} is the only photo of its camera",
                f"a static artifact takes at least {MIN_PHOTOS} to detect: add photos or remove this one",
            )
        cameras.append(Camera(name, len(members), partial(ordered_map, dataset.read_photo, members)))
    return cameras


def _of_source(source: Source, frames: int) -> Camera:
    if source.videos:
        return Camera(source.name, frames, lambda _: _frames(source, frames))
    upright = partial(read_photo, upright=True)
    return Camera(source.name, len(source.photos), partial(ordered_map, upright, source.photos))


def _frames(source: Source, frames: int) -> Iterator[np.ndarray]:
    for _, _, frame in source.video_frames(frames):
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)


def _evidence_image(detection: Detection) -> np.ndarray:
    """Evidence as a color map, brightest at twice the threshold: uint8 [h, w, 3]."""
    level = (detection.evidence.cpu().numpy() / (2 * EVIDENCE_THRESHOLDS[0])).clip(0, 1)
    colored = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return cv2.cvtColor(colored, cv2.COLOR_BGR2RGB)
