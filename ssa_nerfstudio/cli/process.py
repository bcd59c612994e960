"""`ssa process`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ssa_nerfstudio.errors import InputError


@dataclass
class Command:
    """Make a nerfstudio dataset from photos or videos that all show the same artifact; COLMAP comes with pycolmap.

    With --clean a capture in two passes: the photos of --train, which show the artifact, all train, and the clean ones
    all test; both are registered in one frame. What is killed goes on where it was: run the same command again.
    """

    train: Path
    """Photos (JPEG, PNG, HEIC with pillow-heif) or videos of one camera in one orientation: a folder, or one video."""
    output: Path
    """Dataset to write; must not exist."""
    clean: Path | None = None
    """Folder or video of the same scene without the artifact, to evaluate on."""
    mask: Path | None = None
    """Picture of the raw frame's shape that tells where --train shows the artifact: black is ignored, all else is used,
    which is COLMAP's and nerfstudio's polarity. Used for poses alone: training sees the whole photos."""
    invert_mask: bool = False
    """White marks the artifact in --mask instead."""
    detect: bool = False
    """Detect where an opaque artifact is (see ssa detect) and mask it, where --mask is not given. What light
    shines through is never masked: the scene behind it would be lost, too."""
    frames: int = 200
    """Frames to take from the videos of each pass: evenly spaced, the sharpest of their neighborhood."""
    min_registered: float = 0.5
    """Stop when less than this share of a pass's photos could be registered."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """All pairs of photos, or neighbors in time and a net over all; auto: all pairs up to 150 photos."""
    flatten: bool = True
    """Look for features in copies of the photos of --train that lack what is the same in all of them, where they
    share anything; the dataset's photos stay as they are."""
    filter_stationary: bool = True
    """Drop matches that lie at the same place of both frames: what they match is in front of the lens."""
    max_image_size: int = 1600
    """Longest side of the photos that features are looked for in, pixels; the dataset's photos keep their size."""
    threads: int = -1
    """Threads; -1: one a core."""

    def run(self) -> None:
        """Process, and say what was registered and what to do next.

        Raises:
            InputError: the arguments or files cannot be worked with, or too few photos were registered.
        """
        from rich.console import Console

        from ssa_nerfstudio.data.sources import read_source
        from ssa_nerfstudio.sfm.feature_mask import read_mask
        from ssa_nerfstudio.sfm.photos_to_dataset import process
        from ssa_nerfstudio.sfm.reconstruction import SfmSettings

        for name, lowest in (("frames", 3), ("max_image_size", 64)):
            if (value := getattr(self, name)) < lowest:
                raise InputError(f"--{name.replace('_', '-')} must be at least {lowest}, got {value}")
        if not 0 <= self.min_registered <= 1:
            raise InputError(f"--min-registered is a share of the photos, from 0 to 1, got {self.min_registered}")
        if self.threads < 1 and self.threads != -1:
            raise InputError(f"--threads must be at least 1, or -1 for one a core, got {self.threads}")
        if self.output.exists():
            raise InputError(f"{self.output} exists already", "remove it or choose another --output")
        two = self.clean is not None
        sources = [read_source(self.train, "train" if two else "frame", min_photos=3)]
        if self.clean is not None:
            sources.append(read_source(self.clean, "clean", min_photos=1))
        first = sources[0]
        mask = self.mask and read_mask(self.mask, first.width, first.height, self.invert_mask)
        settings = SfmSettings(self.matching, self.max_image_size, self.flatten, self.filter_stationary, self.threads)
        console = Console(highlight=False, soft_wrap=True)
        for source in sources:
            if source.skipped_videos:
                console.print(f"{source.path}: {len(source.skipped_videos)} videos beside the photos are left out")

        summary = process(sources, self.output, mask, self.detect, self.frames, self.min_registered, settings, console)

        for each in summary.passes:
            missing = ", ".join([*each.missing[:5], *["..."][: len(each.missing) > 5]])
            left_out = f"; not: {missing}" if missing else ""
            console.print(f"{each.count} of {each.photos} {each.name} photos registered{left_out}")
        if self.detect and not summary.masked:
            console.print("no opaque artifact was detected: nothing was masked")
        if summary.masked:
            console.print(f"{summary.masked:.0%} of the frame was masked")
        console.print(f"{summary.points} points, mean reprojection error {summary.reprojection_error:.2f} pixels")
        console.print(f"Train on it: ns-train ssa-splatfacto --data {self.output}")
