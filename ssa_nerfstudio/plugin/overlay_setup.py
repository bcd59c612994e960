"""Detects artifacts and initializes overlays before training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from rich.progress import track

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio.cameras.camera_names import camera_names
from ssa_nerfstudio.cameras.intervals import BEGINNING, capture_order, interval_at
from ssa_nerfstudio.cameras.panorama import Face
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.change_points import change_points
from ssa_nerfstudio.evidence.detection import MIN_VIEWS, Detection, detect
from ssa_nerfstudio.evidence.initialization import estimate, guide_of, ignore_changing, initialize, initialize_from
from ssa_nerfstudio.evidence.layer_estimate import MIN_SHARE
from ssa_nerfstudio.evidence.mean_light import refine_in_mean_light, second_estimate
from ssa_nerfstudio.evidence.point_samples import View, sample_points
from ssa_nerfstudio.evidence.present_area import present_area
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate
from ssa_nerfstudio.overlay.layer import OracleOverlay, ScreenSpaceOverlay
from ssa_nerfstudio.plugin.decisions import tell
from ssa_nerfstudio.plugin.face_overlaps import joined_overlays
from ssa_nerfstudio.plugin.settings import ModelSettings
from ssa_nerfstudio.plugin.view_geometry import view_matrix

_KINDS = {"none": "soft", "faint": "semi-transparent", "opaque": "opaque, at least in part"}
"""By detection's verdict, in the words of `evidence.verdict_in_words`; soft: seen by the scene's points alone."""

NamedPhoto = tuple[str, dict[str, Any]]
"""Path relative to the dataset, and the photo with its mask as the datamanager caches them."""


@dataclass(frozen=True)
class LearnedGroup:
    """Photos that share an overlay."""

    members: list[int]
    """Their numbers."""
    start: str
    """Name of the first, or BEGINNING (`cameras.intervals`)."""
    camera: str
    """Name of their camera."""
    overlay: ScreenSpaceOverlay | None
    """None where no artifact is detected, under overlay "auto"."""


def learned_overlays(
    config: ModelSettings,
    photos: list[dict[str, Any]],
    names: list[str],
    cameras: Cameras,
    points: torch.Tensor | None,
    groups: list[int],
    sizes: list[tuple[int, int]],
    gains: torch.Tensor | None = None,
    withheld: Callable[[int], list[NamedPhoto]] = lambda group: [],
    faces: list[Face] | None = None,
) -> list[LearnedGroup]:
    """Make an overlay for each camera group, or for each of its intervals where the artifact changes.

    Args:
        config: the model's; overlay "auto" or "on".
        photos: the datamanager's undistorted cache, in any order.
        names: of the photos, relative to the dataset.
        cameras: of the photos.
        points: of the scene [N, 3], from structure from motion; None where there are none.
        groups: each photo's group.
        sizes: height and width of each group's frame.
        gains: of the photos [V, 3], where their exposure varies; colors of points are compared without them.
        withheld: further photos of a group behind the same artifact, not to be trained on. Where the others show no
            artifact, they help to decide whether there is one, and nothing else.
        faces: of a panorama, that the groups are; None where they are none.
    """
    learned: list[LearnedGroup] = []
    verdicts: dict[int, tuple[str, str]] = {}  # of faces, which may change
    photos_of = [[index for index, at in enumerate(groups) if at == camera] for camera in range(len(sizes))]
    called = camera_names([[names[index] for index in members] for members in photos_of])
    for group, (members, size, camera) in enumerate(zip(photos_of, sizes, called, strict=True)):
        name = "the photos" if len(sizes) == 1 else f"the photos of {camera}"
        members.sort(key=lambda index: capture_order(names[index]))
        statistics, intervals = None, [members]
        if config.overlay == "auto" or config.overlay_start != "constant":
            statistics = _statistics([photos[index] for index in members], name)
            if config.overlay_intervals == "auto":
                ends = [0, *change_points(statistics), len(members)]
                intervals = [members[start:end] for start, end in pairwise(ends)]
        if len(intervals) > 1:
            _report_changes([names[interval[0]] for interval in intervals[1:]], name)
        starts = [BEGINNING, *(names[interval[0]] for interval in intervals[1:])]
        for number, interval in enumerate(intervals):
            part = _Part(
                name,
                [(names[index], photos[index]) for index in interval],
                cameras[torch.tensor(interval)],
                None if gains is None else gains[interval],
                size,
                partial(_of_interval, withheld, group, starts, number),
                tell if faces is None else partial(_keep, verdicts, len(learned)),
            )
            if len(intervals) > 1:
                first, last = Path(names[interval[0]]).name, Path(names[interval[-1]]).name
                part = replace(part, name=f"{name} from {first} to {last}")
                statistics = _statistics(part.images, part.name)
            overlay = _learned_overlay(config, part, statistics, points)
            learned.append(LearnedGroup(interval, starts[number], camera, overlay))
    if faces is not None and len(learned) == len(faces):
        joined = joined_overlays(faces, [each.overlay for each in learned], config.overlay_downscale)
        for index, overlay in joined.items():
            if learned[index].overlay is None:
                reaches = (
                    f"The artifact reaches into the photos of {learned[index].camera} from the face beside them: "
                    "training with an overlay. (--pipeline.model.overlay off trains without.)"
                )
                verdicts[index] = reaches, reaches
            learned[index] = replace(learned[index], overlay=overlay)
    for verdict in verdicts.values():
        tell(*verdict)
    return learned


def _keep(verdicts: dict[int, tuple[str, str]], index: int, verdict: str, brief: str) -> None:
    verdicts[index] = verdict, brief


@dataclass(frozen=True)
class _Part:
    """The photos of a camera, or of one of its intervals."""

    name: str
    """For messages."""
    photos: list[NamedPhoto]
    """In the order of the capture."""
    cameras: Cameras
    gains: torch.Tensor | None
    size: tuple[int, int]
    withheld: Callable[[], list[NamedPhoto]]
    say: Callable[[str, str], None]
    """Takes the verdict in one line, and its brief form (`decisions.tell`)."""

    @property
    def images(self) -> list[dict[str, Any]]:
        return [photo for _, photo in self.photos]

    def artifact_in_all(self) -> bool:
        """Whether there is one in these photos and the withheld ones together."""
        withheld = self.withheld()
        everything = sorted([*self.photos, *withheld], key=lambda photo: capture_order(photo[0]))
        return bool(withheld) and detect(_statistics([photo for _, photo in everything], self.name)).verdict != "none"


def _of_interval(
    withheld: Callable[[int], list[NamedPhoto]], group: int, starts: list[str], number: int
) -> list[NamedPhoto]:
    return [photo for photo in withheld(group) if interval_at(photo[0], starts) == number]


def _learned_overlay(
    config: ModelSettings,
    part: _Part,
    statistics: ImageStatistics | None,
    points: torch.Tensor | None,
    known: str = "",
) -> ScreenSpaceOverlay | None:
    """The overlay of a part; None where there is no artifact, under overlay "auto".

    Args:
        config: the model's.
        part: which.
        statistics: of its photos; None where none are needed.
        points: of the scene.
        known: what else has shown that there is an artifact.
    """

    def overlay(adds_light: bool) -> ScreenSpaceOverlay:
        return ScreenSpaceOverlay(*part.size, config.overlay_downscale, adds_light)

    light = config.overlay_light == "on"
    if statistics is None:
        return overlay(light)
    by_points = config.overlay_start not in ("statistics", "constant")  # "detected" in earlier config.yml files, too
    if config.overlay == "on" and config.overlay_start == "statistics":
        initialize(papers := overlay(light), statistics)
        return papers
    detection, guide = detect(statistics, known=bool(known)), guide_of(statistics)
    found = None
    if points is not None and (config.overlay == "auto" or by_points):
        device, views = part.images[0]["image"].device, views_of(part.images, part.cameras, part.gains)
        samples = sample_points(points.to(device), views, guide, detection.opaque)
        found = estimate(samples, guide, detection.opaque, detection.mask) if len(samples.point) else None
    if config.overlay == "auto":
        share = 0.0 if found is None else found.share()
        if detection.verdict == "none" and share < MIN_SHARE and not known:
            if part.artifact_in_all():
                return _learned_overlay(config, part, statistics, points, "with the test photos")
            part.say(*_in_words(detection, share, part.name))
            return None
        part.say(*_in_words(detection, share, part.name, known))
    if by_points and found is not None:
        if config.overlay_light == "auto":
            light = found.adds_light(present_area(found.opacity(), detection.mask))
        started = overlay(light)
        initialize_from(started, found, guide, detection.mask)
        may_move = False
        if config.shading != "off" and part.gains is None:
            second = second_estimate(started, found, samples, guide, views, detection)
            found, may_move = refine_in_mean_light(started, found, second, detection.mask)
        if config.ignore_changing:
            ignore_changing(started, found, samples if may_move else None)
        return started
    started = overlay(light)
    if by_points:
        initialize(started, statistics, None if detection.views < MIN_VIEWS else detection.mask)
    elif config.overlay_start == "statistics":
        initialize(started, statistics)
    return started


def views_of(photos: list[dict[str, Any]], cameras: Cameras, gains: torch.Tensor | None = None) -> list[View]:
    """Join photos of the datamanager's cache with their cameras, and with their gains [V, 3]."""
    poses, lenses = view_matrix(cameras.camera_to_worlds), cameras.get_intrinsics_matrices()
    if photos:
        device = photos[0]["image"].device  # where the points are projected; at once instead of view by view
        poses, lenses = poses.to(device), lenses.to(device)
    return [
        View(photo["image"], photo.get("mask"), poses[i], lenses[i], None if gains is None else gains[i])
        for i, photo in enumerate(photos)
    ]


def given_overlays(path: Path | None, sizes: list[tuple[int, int]]) -> list[OracleOverlay]:
    """Read the oracle overlay of every camera group from an .npz file.

    Raises:
        InputError: it holds none, or layers of other sizes.
    """
    if path is None:
        raise InputError(
            "overlay 'given' needs the layers", "add --pipeline.model.overlay-given FILE.npz with arrays T and B"
        )
    try:
        arrays = np.load(path)
        names = [("T", "B")] if len(sizes) == 1 and "T" in arrays else [(f"T{g}", f"B{g}") for g in range(len(sizes))]
        overlays = [OracleOverlay(torch.from_numpy(arrays[t]), torch.from_numpy(arrays[b])) for t, b in names]
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(f"{path} holds no usable layers ({error})", "give an .npz with T and B [H, W, 3]") from error
    for overlay, size in zip(overlays, sizes, strict=True):
        if (overlay.height, overlay.width) != size:
            raise InputError(
                f"{path} has layers of {overlay.height} x {overlay.width} pixels, the undistorted photos have "
                f"{size[0]} x {size[1]}",
                "give the layers in the undistorted frame at the training resolution",
            )
    return overlays


def _statistics(photos: list[dict[str, Any]], name: str) -> ImageStatistics:
    views = ((photo["image"], photo.get("mask")) for photo in photos)
    return accumulate(track(views, f"Statistics of {name}", total=len(photos), transient=True))


def _report_changes(starts: list[str], name: str) -> None:
    """Tell where the artifact changes in one line, with the option that overrides it."""
    tell(
        f"{name[0].upper() + name[1:]} have an artifact that changes at {', '.join(starts)}: {len(starts) + 1} "
        "intervals, each tested by itself. (--pipeline.model.overlay-intervals off takes them as one.)"
    )


def _in_words(detection: Detection, share: float, name: str, known: str = "") -> tuple[str, str]:
    """The verdict in one line, with the option that overrides it, and without what detection alone would say, too."""
    name = name[0].upper() + name[1:]
    if detection.verdict != "none" or share >= MIN_SHARE or known:
        covered = detection.coverage if detection.verdict != "none" else share
        # Detection, which sees the photos as they were taken, has another share of another frame.
        what = f" ({_KINDS[detection.verdict]}, {covered:.1%} of the undistorted frame)"
        told, decided = f"{name} have a static artifact{known and f', {known}'}", "training with an overlay. "
        decided += "(--pipeline.model.overlay off trains without.)"
        return f"{told}{what}: {decided}", f"{told}{what if detection.verdict == 'none' else ''}: {decided}"
    reason = "too few to tell" if detection.views < MIN_VIEWS else "as many static edges as chance has"
    reason = "some edges stand still, but too few to be one" if detection.too_few_edges else reason
    if share >= 0.001:
        # Rounded down: what is said to count would be an artifact.
        reason += f"; {int(1000 * share) / 1000:.1%} of the frame seems hidden or lit, {MIN_SHARE:.0%} would count"
    text = (
        f"{name} show no static artifact ({counted(detection.views, 'view')}, {reason}): training without an overlay. "
        "(--pipeline.model.overlay on trains with one.)"
    )
    return text, text
