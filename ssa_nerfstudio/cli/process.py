"""`ssa process`."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.name_list import name_list
from ssa_nerfstudio._system.terminal_messages import plain_console
from ssa_nerfstudio.cameras.projections import FaceName, Projection
from ssa_nerfstudio.cli.option_bounds import at_least
from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    from ssa_nerfstudio.data.sources import Source
    from ssa_nerfstudio.sfm.photos_to_dataset import Summary


@dataclass
class Command:
    """Make a nerfstudio dataset from photos or videos that all show the same artifact; COLMAP comes with pycolmap.

    With --clean, a capture in two passes: the photos of --train, which show the artifact, train, and the clean ones
    test; both are registered in one frame. An interrupted run is continued by the same command.
    """

    train: Path
    """Photos (JPEG, PNG, HEIC with pillow-heif) or videos: a folder, one video, or a folder of a rig with a subfolder
    for each camera."""
    output: Path
    """Dataset to write; must not exist."""
    clean: Path | None = None
    """Folder or video of the same scene without the artifact, to evaluate on."""
    colmap: Path | None = None
    """A model that COLMAP has made of the photos of --train (.bin or .txt), to be repaired: poses that hold off the
    artifact are kept, and the other photos are registered to them. Implies --detect, where --mask is not given."""
    mask: Path | None = None
    """Mask of the artifact in the photos of --train, of the raw frame's shape: black is ignored, all else used, as by
    COLMAP and nerfstudio. Used for poses alone; training uses whole photos."""
    invert_mask: bool = False
    """The artifact is white in --mask instead."""
    detect: bool = False
    """Detect an opaque artifact (see ssa detect) and mask it, where --mask is not given. Semi-transparent artifacts are
    never masked: the scene behind them would be lost, too."""
    frames: Annotated[int, at_least(3)] = 200
    """Frames to take from the videos of each pass: evenly spaced, the sharpest of their neighborhood."""
    min_registered: float = 0.5
    """Stop when less than this share of a pass's photos is registered; 0: when none is."""
    projection: Projection = "auto"
    """What the photos are. fisheye gets lenses of OPENCV_FISHEYE, which training undistorts. Equirectangular (360
    degrees, 2:1) photos are cut into six perspective faces. auto takes 2:1 photos for such whose left edge continues
    the right one, and all others for perspective."""
    leave_out: tuple[FaceName, ...] = ()
    """Faces of equirectangular photos to leave out, for example down, where only the operator or a tripod is seen."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """All pairs of photos, or neighbors in time and pairs of keyframes; auto: all pairs up to 150 photos."""
    flatten: bool = True
    """Extract features in copies of the photos of --train without their static factor (blind flat-field correction),
    where they have one; the dataset's photos stay as they are."""
    filter_stationary: bool = True
    """Drop matches at the same place of both frames: they are on the artifact."""
    max_image_size: Annotated[int, at_least(64)] = 1600
    """Longest side of the photos in which features are extracted, pixels; the dataset's photos keep their size."""
    threads: int = -1
    """Number of threads; -1: one per core."""

    def prepared(self) -> tuple[list[Source], Callable[..., Summary]]:
        """Check the options and find the photos.

        Returns:
            The cameras to train on, and the work: `photos_to_dataset.process`, which only lacks `found` and
            `on_progress`.

        Raises:
            InputError: an option or a file cannot be used.
        """
        from ssa_nerfstudio.data.equirectangular import with_faces
        from ssa_nerfstudio.data.photos import MAX_PIXELS
        from ssa_nerfstudio.data.sources import read_source, read_sources
        from ssa_nerfstudio.sfm.existing_model import read_existing_model
        from ssa_nerfstudio.sfm.feature_mask import read_mask
        from ssa_nerfstudio.sfm.photos_to_dataset import process
        from ssa_nerfstudio.sfm.reconstruction import SfmSettings

        if not 0 <= self.min_registered <= 1:
            raise InputError(f"--min-registered is a share of the photos, from 0 to 1, got {self.min_registered}")
        if self.threads < 1 and self.threads != -1:
            raise InputError(f"--threads must be at least 1, or -1 for one a core, got {self.threads}")
        if self.invert_mask and self.mask is None:
            raise InputError("--invert-mask is for --mask", "give a mask, or leave it out")
        two = self.clean is not None
        sources = read_sources(self.train, "train" if two else "frame", min_photos=3)
        clean = None if self.clean is None else read_source(self.clean, "clean", min_photos=1)
        if clean is not None:
            trained = {os.path.realpath(file) for source in sources for file in source.files}
            if twice := [file for file in clean.files if os.path.realpath(file) in trained]:
                raise InputError(f"{twice[0]} is in --train, too", "--clean takes photos without the artifact")
        if clean is not None and clean.name in {source.name for source in sources}:
            raise InputError(f"{self.train} has a camera called {clean.name}, as --clean", "rename its folder")
        known = None
        if self.colmap is not None:
            if self.projection not in ("auto", "perspective") or self.leave_out:
                raise InputError("--colmap takes models of perspective photos", "leave it out, or the faces' options")
            known = read_existing_model(self.colmap, self.train, sources)
            sources = list(known.sources)
        else:
            sources = with_faces(sources, self.projection, self.leave_out)
        if clean is not None and known is None:
            (clean,) = with_faces([clean], self.projection, self.leave_out)
        first = sources[0]
        if self.mask is not None and len(sources) > 1:
            raise InputError(
                f"{self.train} holds the photos of {len(sources)} cameras, --mask is one camera's",
                "leave it out, as --detect masks each camera's own artifact"
                if self.detect
                else "use --detect, or process the cameras one by one",
            )
        mask = self.mask and read_mask(self.mask, first.width, first.height, self.invert_mask)
        model = "OPENCV_FISHEYE" if self.projection == "fisheye" else "OPENCV"
        # More have no use, and COLMAP fails at numbers beyond what it can start or count.
        threads, size = min(self.threads, usable_cores()), min(self.max_image_size, MAX_PIXELS)
        settings = SfmSettings(self.matching, size, self.flatten, self.filter_stationary, model, threads)
        detect = self.detect or known is not None
        return sources, partial(
            process, sources, self.output, mask, detect, clean, self.frames, self.min_registered, settings, known
        )

    def run(self) -> None:
        """Process, and print what was registered and what to do next.

        Raises:
            InputError: an option or a file cannot be used, or too few photos were registered.
        """
        from ssa_nerfstudio.data.equirectangular import cut_into_faces
        from ssa_nerfstudio.sfm.progress_display import progress_display

        if self.output.exists():
            raise InputError(f"{self.output} exists already", "remove it or choose another --output")
        sources, process = self.prepared()
        console = plain_console()
        for source in sources:
            if source.faces:
                console.print(cut_into_faces(source))
            if source.skipped_videos:
                console.print(
                    f"{source.path}: left out beside the photos: {counted(len(source.skipped_videos), 'video')}"
                )
        with progress_display(console) as on_progress:
            summary = process(on_progress=on_progress)

        if summary.repair is not None:
            console.print(f"{self.colmap}: {summary.repair.in_words()}")
        for each in summary.passes:
            camera = f"{each.name}: " if len(summary.passes) > 1 else ""
            left_out = f"; not: {name_list(each.missing)}" if each.missing else ""
            console.print(f"{camera}{each.count} of {each.photos} photos registered{left_out}")
        if summary.unmasked:
            console.print("more photos registered without a mask of the detected artifact: nothing was masked")
        elif self.detect and not summary.masked:
            console.print("no opaque artifact was detected: nothing was masked")
        if summary.masked:
            console.print(f"{summary.masked:.0%} of the frame was masked")
        console.print(f"{summary.points} points, mean reprojection error {summary.reprojection_error:.2f} pixels")
        console.print(f"Train on it: ns-train ssa-splatfacto --data {shlex.quote(str(self.output))}")
