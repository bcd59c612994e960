"""Detects artifacts and initializes overlays before training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.evidence.detection import MIN_VIEWS, Detection, detect, static_area
from ssa_nerfstudio.evidence.initialization import initialize
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate
from ssa_nerfstudio.overlay.layer import OracleOverlay, ScreenSpaceOverlay
from ssa_nerfstudio.plugin.settings import ModelSettings


def learned_overlays(
    config: ModelSettings, photos: list[dict[str, Any]], groups: list[int], sizes: list[tuple[int, int]]
) -> list[ScreenSpaceOverlay | None]:
    """Make an overlay for each camera group; under overlay "auto" None where no artifact is detected.

    Args:
        config: the model's; overlay "auto" or "on".
        photos: the datamanager's undistorted cache, in the order of the capture.
        groups: each photo's group.
        sizes: height and width of each group's frame.
    """
    overlays: list[ScreenSpaceOverlay | None] = []
    for group, size in enumerate(sizes):
        name = "the photos" if len(sizes) == 1 else f"camera {group + 1} of {len(sizes)}"
        views = [photo for photo, at in zip(photos, groups, strict=True) if at == group]
        overlays.append(_learned_overlay(config, views, size, name))
    return overlays


def _learned_overlay(
    config: ModelSettings, photos: list[dict[str, Any]], size: tuple[int, int], name: str
) -> ScreenSpaceOverlay | None:
    adds_light = config.overlay_light == "on"
    if config.overlay == "on" and config.overlay_start == "constant":
        return ScreenSpaceOverlay(*size, config.overlay_downscale, adds_light)
    statistics = _statistics(photos, name)
    area = None
    if config.overlay == "auto":
        detection = detect(statistics)
        _report(detection, name)
        if detection.verdict == "none":
            return None
        area = detection.area
    if config.overlay_start == "detected":
        area = static_area(statistics) if area is None else area
        if config.overlay_light == "auto":
            adds_light = area.adds_light
    overlay = ScreenSpaceOverlay(*size, config.overlay_downscale, adds_light)
    if config.overlay_start != "constant":
        initialize(overlay, statistics, area if config.overlay_start == "detected" else None)
    return overlay


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


def _report(detection: Detection, name: str) -> None:
    """Print the verdict in one line, with the option that overrides it."""
    name = name[0].upper() + name[1:]
    if detection.verdict != "none":
        CONSOLE.print(
            f"{name} have a static artifact ({detection.verdict}, {detection.coverage:.1%} of the frame): training "
            "with an overlay. (--pipeline.model.overlay off trains without.)"
        )
        return
    reason = "too few to tell" if detection.views < MIN_VIEWS else f"p = {detection.p_value:.2g}"
    reason += ", too few static edges to report" if detection.too_few_edges else ""
    CONSOLE.print(
        f"{name} show no static artifact ({detection.views} views, {reason}): training without an overlay. "
        "(--pipeline.model.overlay on trains with one.)"
    )
