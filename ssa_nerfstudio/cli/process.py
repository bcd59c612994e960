"""`ssa process`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ssa_nerfstudio.errors import InputError


@dataclass
class Command:
    """Make a nerfstudio dataset from photos or videos that all show the same artifact; COLMAP comes with pycolmap.

    With --clean, a capture in two passes: the photos of --train, which show the artifact, train, and the clean ones
    test; both are registered in one frame. An interrupted run is continued by the same command.
    """

    train: Path
    """Photos (JPEG, PNG, HEIC with pillow-heif) or videos of one camera in one orientation: a folder, or one video."""
    output: Path
    """Dataset to write; must not exist."""
    clean: Path | None = None
    """Folder or video of the same scene without the artifact, to evaluate on."""
    mask: Path | None = None
    """Mask of the artifact in the photos of --train, of the raw frame's shape: black is ignored, all else used, as by
    COLMAP and nerfstudio. Used for poses alone; training uses whole photos."""
    invert_mask: bool = False
    """The artifact is white in --mask instead."""
    detect: bool = False
    """Detect an opaque artifact (see ssa detect) and mask it, where --mask is not given. Semi-transparent artifacts are
    never masked: the scene behind them would be lost, too."""
    frames: int = 200
    """Frames to take from the videos of each pass: evenly spaced, the sharpest of their neighborhood."""
    min_registered: float = 0.5
    """Stop when less than this share of a pass's photos is registered."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """All pairs of photos, or neighbors in time and pairs of keyframes; auto: all pairs up to 150 photos."""
    flatten: bool = True
    """Extract features in copies of the photos of --train without their static factor (blind flat-field correction),
    where they have one; the dataset's photos stay as they are."""
    filter_stationary: bool = True
    """Drop matches at the same place of both frames: they are on the artifact."""
    max_image_size: int = 1600
    """Longest side of the photos in which features are extracted, pixels; the dataset's photos keep their size."""
    threads: int = -1
    """Number of threads; -1: one per core."""

    def run(self) -> None:
        """Process, and print what was registered and what to do next.

        Raises:
            InputError: an option or a file cannot be used, or too few photos were registered.
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
