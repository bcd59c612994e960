"""`ssa export-overlay`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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
    threshold: float = 0.5
    """Matte above which a pixel is artifact in the masks, in (0, 1). For structure from motion 0.2 is safer."""
    step: int | None = None
    """Checkpoint to read; the newest where not given."""
    apply: Path | None = None
    """Folder of photos, original or undistorted, at any resolution: written without the artifact to OUTPUT/photos,
    black where the matte is above 0.95."""
    camera: int | None = None
    """For --apply with a rig: the camera of these photos, counted from 0 as in overlay.json."""

    def run(self) -> None:
        """Read the checkpoint, write, and print what could not be recovered.

        Raises:
            InputError: an option, the checkpoint or a photo cannot be used.
        """
        if not 0 < self.threshold < 1:
            raise InputError(f"--threshold must be in (0, 1), got {self.threshold:g}")
        if self.camera is not None and self.apply is None:
            raise InputError("--camera chooses the camera of --apply", "add --apply PHOTOS")
        from rich.console import Console
        from rich.progress import track

        from ssa_nerfstudio.data.writing import staged_folder
        from ssa_nerfstudio.export.artifact_files import write_overlay
        from ssa_nerfstudio.export.artifact_layers import raw_layers, undistorted_layers
        from ssa_nerfstudio.export.checkpoint import Checkpoint
        from ssa_nerfstudio.export.restoration import find_photos, restore_photos

        checkpoint = Checkpoint.read(self.load_config, self.step)
        undistorted = undistorted_layers(checkpoint)
        raw = raw_layers(checkpoint) if self.raw_frame or self.apply else undistorted
        frames, photos = [], []
        if self.apply is not None:
            photos = find_photos(self.apply)
            frames = [*raw, *undistorted]
            if len(raw) > 1:
                if self.camera is None or not 0 <= self.camera < len(raw):
                    raise InputError(
                        f"the run has {len(raw)} cameras",
                        f"choose the camera of these photos: --camera 0 to {len(raw) - 1}",
                    )
                frames = [raw[self.camera], undistorted[self.camera]]
        console = Console(highlight=False, soft_wrap=True)
        with staged_folder(self.output) as folder:
            written = write_overlay(folder, checkpoint, raw if self.raw_frame else undistorted, self.threshold)
            photos_done = restore_photos(self.apply or folder, photos, frames, folder)
            recovered = list(track(photos_done, "Photos", total=len(photos), console=console, transient=True))
        for number, camera in enumerate(written["cameras"]):
            console.print(
                f"{self.output / camera['folder']}: camera {number}, {camera['frame']} frame, "
                f"{camera['covered_fraction']:.1%} with a matte above {self.threshold:g}, mean matte "
                f"{camera['mean_matte']:.3f}"
            )
        if recovered:
            hidden = sum(r.hidden for r in recovered) / len(recovered)
            implausible = max(recovered, key=lambda r: r.implausible)
            console.print(
                f"{self.output / 'photos'}: {len(recovered)} photos; {hidden:.1%} of their pixels lie behind a matte "
                f"above 0.95 and could not be recovered (black). Where the artifact is estimated wrongly, pixels leave "
                f"the range of colors: at most {implausible.implausible:.1%} of a photo ({implausible.path})."
            )
            if clipped := sum(r.clipped for r in recovered) / len(recovered):
                console.print(
                    f"The artifact adds light, and {clipped:.1%} of the pixels are white by it: there the scene is at "
                    "least as bright as what was written."
                )
