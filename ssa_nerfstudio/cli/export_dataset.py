"""`ssa export-dataset`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.terminal_messages import photo_bar, plain_console
from ssa_nerfstudio.cli.option_bounds import Count, Share
from ssa_nerfstudio.errors import InputError

if TYPE_CHECKING:
    from ssa_nerfstudio.data.dataset import Dataset
    from ssa_nerfstudio.export.capture_artifact import CaptureArtifact


@dataclass
class Command:
    """Write a capture for another program: photos, masks of the artifact, poses, and a README with its command."""

    output: Path
    """Folder to write; must not exist."""
    program: Annotated[
        Literal["nerfstudio", "colmap", "lichtfeld", "brush", "3dgrut", "postshot"], tyro.conf.arg(name="for")
    ]
    """Who is to read it: names, folders and polarity of masks are that program's."""
    load_config: Path | None = None
    """The config.yml of a run, whose overlay is the mask. Without it the artifact is detected, which takes --data."""
    data: Path | None = None
    """The nerfstudio dataset; of a run its own where not given."""
    photos: Literal["original", "cleaned"] = "original"
    """Photos as they are, or without the artifact (needs --load-config)."""
    masks: Literal["auto", "artifact", "holes", "none"] = "auto"
    """What is masked: artifact: all that it changes; holes: what cleaned photos could not recover; auto: artifact for
    original photos, holes for cleaned ones."""
    frame: Literal["auto", "raw", "undistorted"] = "auto"
    """Photos with or without the lens' distortion; auto: what the program takes best."""
    threshold: Share = 0.5
    """Matte above which a pixel is artifact, in (0, 1); needs --load-config."""
    downscale_factor: Count = 1
    """N > 1 reads images_N."""

    def run(self) -> None:
        """Read run and dataset, write, and print what is left.

        Raises:
            InputError: an option, the checkpoint or a photo cannot be used.
        """
        if self.load_config is None and self.data is None:
            raise InputError("there is nothing to export", "give --load-config of a run, or --data of a dataset")
        for option, asked in (
            ("--downscale-factor", self.downscale_factor != 1),
            ("--photos cleaned", self.photos == "cleaned"),
            ("--threshold", self.threshold != Command.threshold),
        ):
            if asked and self.load_config is None:
                raise InputError(f"{option} takes the overlay of a run", "add --load-config")
        if self.output.exists():
            raise InputError(f"{self.output} exists already", "remove it or choose another --output")

        from ssa_nerfstudio.data.dataset import Dataset
        from ssa_nerfstudio.data.writing import staged_folder
        from ssa_nerfstudio.export.checkpoint import data_of_run
        from ssa_nerfstudio.export.dataset_export import DatasetExport

        console = plain_console()
        data = self.data or data_of_run(self.load_config)  # pyright: ignore[reportArgumentType]
        dataset = Dataset.read(data, eval_interval=8, downscale_factor=self.downscale_factor)
        artifact = self._artifact(dataset, data)
        export = DatasetExport(dataset, artifact, self.program, self.photos, self.masks, self.frame)
        with staged_folder(self.output) as folder:
            photos = list(photo_bar(export.write_photos(folder), len(export.views), console))
            export.write_poses(folder, photos)
        left = sum(photo.left for photo in photos) / len(photos)
        console.print(
            f"{self.output}: {counted(len(photos), 'photo')} for {export.preset.title}, {export.frame} frame; "
            f"on average {left:.1%} of a photo is not masked, of the one with the largest mask "
            f"{min(photo.left for photo in photos):.1%}"
        )
        console.print(f"There: {export.preset.start}")

    def _artifact(self, dataset: Dataset, data: Path) -> CaptureArtifact:
        """The artifact of the run, else as detected."""
        from ssa_nerfstudio.evidence.capture_detection import detect_artifacts
        from ssa_nerfstudio.export.capture_artifact import DetectedArtifact, LearnedArtifact
        from ssa_nerfstudio.export.checkpoint import Checkpoint

        if self.load_config is not None:
            return LearnedArtifact(Checkpoint.read(self.load_config), self.threshold)
        lenses = [view.lens for view in dataset.views if view.role == "train"]
        return DetectedArtifact(lenses, list(detect_artifacts(data).values()))
