"""What a finished training shows: metrics of its test views, and one view a camera with and without the artifact."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ssa_nerfstudio._system.text_files import read_text
from ssa_nerfstudio.cameras.camera_names import camera_names
from ssa_nerfstudio.data.transforms import Transforms
from ssa_nerfstudio.plugin.artifacts import Artifacts
from ssa_nerfstudio.plugin.camera_matching import find_frame, group_cameras
from ssa_nerfstudio.plugin.evaluation import view_metrics
from ssa_nerfstudio.plugin.pipeline import SSAPipeline
from ssa_nerfstudio.sfm.progress_display import ProgressCallback

WIDEST = 960
"""Longest side of a stored picture, pixels."""
_FILE = "evaluation.json"


@dataclass(frozen=True)
class PicturedGroup:
    """The photos of one camera, or of one interval of it where the artifact changes."""

    title: str
    """Name of the camera, and where the interval begins."""
    overlay: str | None
    """Name of their overlay (`Artifacts.name`); None where they have none."""


@dataclass(frozen=True)
class Evaluation:
    """Metrics of the test views."""

    metrics: dict[str, float]
    """Means over the test views, by name; empty where there are none, as of fewer than ten photos."""
    views: dict[str, dict[str, float]]
    """Metrics by the photo's path in the dataset."""
    clean_test_views: bool
    """See `Transforms.test_photos_are_clean`."""
    pictured: list[PicturedGroup] = field(default_factory=list)
    """What `write_view_pictures` shows, in its order."""
    detected: bool = False
    """Whether detection found an artifact in the photos of a camera, before the training."""

    @property
    def has_overlay(self) -> bool:
        """Whether the training learned the artifact of a camera."""
        return any(group.overlay is not None for group in self.pictured)

    @property
    def carried(self) -> bool:
        """Whether test photos carry an artifact, so that the clean render differs from them however good it is."""
        return not self.clean_test_views and (self.detected or self.has_overlay)

    @staticmethod
    def read(folder: Path) -> Evaluation:
        """Read what `write` wrote."""
        values = json.loads(read_text(folder / _FILE))
        return Evaluation(**{**values, "pictured": [PicturedGroup(**each) for each in values["pictured"]]})

    def write(self, folder: Path) -> None:
        """Write evaluation.json."""
        (folder / _FILE).write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")


@torch.no_grad()
def evaluate(pipeline: SSAPipeline, data: Path, detected: bool, on_progress: ProgressCallback) -> Evaluation:
    """Compare the clean render, and with an overlay the composite, with every test photo.

    Args:
        pipeline: a trained one, with its test views.
        data: its dataset.
        detected: whether detection found an artifact in its photos.
        on_progress: called after every view.
    """
    names = pipeline.datamanager.photo_names(pipeline.datamanager.eval_dataset)
    views = {}
    for name, (camera, batch) in zip(names, pipeline.datamanager.fixed_indices_eval_dataloader, strict=True):
        outputs = pipeline.model.get_outputs_for_camera(camera)
        views[name] = view_metrics(outputs, pipeline.model.target(outputs, batch))
        on_progress("test view", len(views), len(names))
    keys = next(iter(views.values()), {})
    means = {key: sum(view[key] for view in views.values()) / len(views) for key in keys}
    return Evaluation(means, views, Transforms.read(data).test_photos_are_clean, _pictured(pipeline), detected)


def _pictured(pipeline: SSAPipeline) -> list[PicturedGroup]:
    artifacts = pipeline.model.artifacts
    names = [artifacts.name(group) for group in range(len(artifacts))]
    if artifacts.changes:
        starts = [Path(artifacts.starts[group]).name or "the first photo" for group in range(len(artifacts))]
        several = len({*artifacts.cameras}) > 1
        cameras = [f"{artifacts.cameras[group]}, " if several else "" for group in range(len(artifacts))]
        return [PicturedGroup(f"{c}from {s}", name) for c, s, name in zip(cameras, starts, names, strict=True)]
    photos = pipeline.datamanager.cached_train  # undistorts the photos and rewrites their cameras
    dataset = pipeline.datamanager.train_dataset
    keys, groups = group_cameras(dataset.cameras)
    paths = pipeline.datamanager.photo_names(dataset)
    members = [[paths[view] for view in range(len(photos)) if groups[view] == group] for group in range(len(keys))]
    places = _places(keys, artifacts) if names else [len(names)] * len(keys)
    overlays = [names[place] if place < len(names) else None for place in places]
    return [PicturedGroup(title, overlay) for title, overlay in zip(camera_names(members), overlays, strict=True)]


def _places(keys: Tensor, artifacts: Artifacts) -> list[int]:
    """A group of each camera [G, 6], the number of groups for a camera that the model has not seen."""
    known = torch.cat([artifacts.camera_keys, artifacts.bare_keys]).cpu()
    places = [find_frame(key, known) for key in keys]
    return [len(known) if place is None else place for place in places]


@torch.no_grad()
def write_view_pictures(pipeline: SSAPipeline, folder: Path) -> None:
    """Write the middle training photo of each camera, and the same view without the artifact.

    Where the artifact changes, of each interval that has one.

    Args:
        pipeline: a trained one.
        folder: exists; photo-1.jpg and clean-1.jpg are written, for a second camera photo-2.jpg, ...
    """
    photos = pipeline.datamanager.cached_train  # undistorts the photos and rewrites their cameras
    dataset = pipeline.datamanager.train_dataset
    cameras, artifacts = dataset.cameras, pipeline.model.artifacts
    keys, groups = group_cameras(cameras)
    if artifacts.changes:
        # A loaded model knows intervals by their photos, not by views.
        places = _places(keys, artifacts)
        names = pipeline.datamanager.photo_names(dataset)
        shown = [artifacts.at_photo(places[group], name) for group, name in zip(groups, names, strict=True)]
        groups = [group if group < len(artifacts) else None for group in shown]
    for group in sorted({group for group in groups if group is not None}):
        members = [view for view, at in enumerate(groups) if at == group]
        middle = members[len(members) // 2]
        camera = cameras[middle : middle + 1].to(pipeline.device)
        clean = pipeline.model.get_outputs_for_camera(camera)["rgb"]
        _save(photos[middle]["image"], folder / f"photo-{group + 1}.jpg")
        _save(clean, folder / f"clean-{group + 1}.jpg")


def _save(image: Tensor, path: Path) -> None:
    """A JPEG of at most `WIDEST` pixels of an image [H, W, 3 or 4], uint8 or in [0, 1]."""
    values = image[..., :3].cpu()
    pixels = values.numpy() if values.dtype == torch.uint8 else np.rint(values.clamp(0, 1).numpy() * 255).astype("u1")
    picture = Image.fromarray(pixels)
    picture.thumbnail((WIDEST, WIDEST), Image.Resampling.LANCZOS)
    picture.save(path, quality=90, subsampling=0)
