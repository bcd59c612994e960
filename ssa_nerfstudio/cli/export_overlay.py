"""`ssa export-overlay`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.terminal_messages import photo_bar, plain_console
from ssa_nerfstudio.cli.option_bounds import Share
from ssa_nerfstudio.errors import InputError


@dataclass
class Command:
    """Write the artifact that a run learned as pictures and masks, and remove it from photos where it lets light
    through."""

    load_config: Path
    """The run's config.yml, wherever its folder is now; neither the photos nor a GPU are needed."""
    output: Path
    """Folder to write; must not exist."""
    raw_frame: bool = False
    """Map everything through the lens distortion to the frame of the original photos, which masks for COLMAP and for
    nerfstudio's mask_path need. Default: the undistorted frame that nerfstudio trains in."""
    equirectangular: bool = False
    """Put the overlays of a 360 degree capture's faces together, in the frame of its equirectangular photos."""
    data: Path | None = None
    """For --equirectangular: the dataset that the run was trained on, where it has moved."""
    threshold: Share = 0.5
    """Matte above which a pixel is artifact in the masks and in restored photos, in (0, 1). For structure from motion
    0.2 is safer."""
    step: int | None = None
    """Checkpoint to read; the newest where not given."""
    apply: Path | None = None
    """Folder of photos or of a video's frames, original or undistorted, at any resolution: written without the artifact
    to OUTPUT/photos, black where the matte is above --threshold. Photos that do not show the artifact are written as
    they are."""
    camera: int | None = None
    """For --apply with a rig, or where the artifact changes: the overlay of these photos, counted from 0 as in
    overlay.json."""

    def run(self) -> None:
        """Read the checkpoint, write, and print what could not be recovered.

        Raises:
            InputError: an option, the checkpoint or a photo cannot be used.
        """
        if self.camera is not None and self.apply is None:
            raise InputError("--camera chooses the camera of --apply", "add --apply PHOTOS")
        if self.equirectangular and (self.raw_frame or self.camera is not None):
            raise InputError("--equirectangular has one frame and one camera", "leave --raw-frame and --camera out")
        if self.data is not None and not self.equirectangular:
            raise InputError("--data is for --equirectangular", "leave it out")

        from ssa_nerfstudio.data.writing import staged_folder
        from ssa_nerfstudio.export.artifact_files import write_overlay
        from ssa_nerfstudio.export.artifact_layers import raw_layers, undistorted_layers
        from ssa_nerfstudio.export.checkpoint import Checkpoint, data_of_run
        from ssa_nerfstudio.export.exposure_file import write_exposure
        from ssa_nerfstudio.export.panorama_artifact import panorama_layers, panorama_of
        from ssa_nerfstudio.export.restoration import find_photos, restore_photos

        checkpoint = Checkpoint.read(self.load_config, self.step)
        undistorted = undistorted_layers(checkpoint)
        if self.equirectangular:
            undistorted = [panorama_layers(undistorted, panorama_of(self.data or data_of_run(self.load_config)))]
        distorted = (self.raw_frame or self.apply) and not self.equirectangular
        raw = raw_layers(checkpoint) if distorted else undistorted
        frames, photos = [], []
        if self.apply is not None:
            photos = find_photos(self.apply)
            frames = [*raw, *undistorted]
            if self.camera is None and len(raw) > 1:
                raise InputError(
                    f"the run has {len(raw)} overlays: {', '.join(layers.name for layers in raw)}",
                    f"choose that of these photos: --camera 0 to {len(raw) - 1}; where the artifact changes, "
                    "ssa export-dataset --photos cleaned chooses each photo's own",
                )
            if self.camera is not None:
                if not 0 <= self.camera < len(raw):
                    raise InputError(
                        f"the run has no overlay {self.camera}", f"there are {len(raw)}, counted from --camera 0"
                    )
                frames = [raw[self.camera], undistorted[self.camera]]
        console = plain_console()
        with staged_folder(self.output) as folder:
            written = write_overlay(folder, checkpoint, raw if self.raw_frame else undistorted, self.threshold)
            write_exposure(checkpoint, folder)
            photos_done = restore_photos(self.apply or folder, photos, frames, folder, self.threshold)
            written_photos = list(photo_bar(photos_done, len(photos), console))
            recovered = [photo for photo in written_photos if photo.shows]
            if photos and not recovered:
                raise InputError(
                    f"none of the photos in {self.apply} shows the artifact where it was learned",
                    "choose photos of the camera that the run was trained on, before anything was removed from them",
                )
        for camera in written["cameras"]:
            console.print(
                f"{self.output / camera['folder']}: {camera['name']}, {camera['frame']} frame, "
                f"{camera['covered_fraction']:.1%} with a matte above {self.threshold:g}, mean matte "
                f"{camera['mean_matte']:.3f}"
            )
        if recovered:
            hidden = sum(r.hidden for r in recovered) / len(recovered)
            implausible = max(recovered, key=lambda r: r.implausible)
            console.print(
                f"{self.output / 'photos'}: {counted(len(recovered), 'photo')}; {hidden:.1%} of their pixels lie "
                f"behind a matte above {self.threshold:g} or at its edge and could not be recovered (black). Where "
                f"the artifact is estimated wrongly, pixels leave the range of colors: at most "
                f"{implausible.implausible:.1%} of a photo ({implausible.path})."
            )
            if unchanged := [str(photo.path) for photo in written_photos if not photo.shows]:
                console.print(
                    f"{counted(len(unchanged), 'photo')} left unchanged, without the artifact where it was learned: "
                    f"{', '.join(unchanged[:3])}{', ...' if len(unchanged) > 3 else ''}."
                )
            if clipped := sum(r.clipped for r in recovered) / len(recovered):
                console.print(
                    f"The artifact adds light, and {clipped:.1%} of the pixels are white by it: there the scene is at "
                    "least as bright as what was written."
                )
