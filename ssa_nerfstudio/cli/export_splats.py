"""`ssa export-splats`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ssa_nerfstudio._system.terminal_messages import plain_console
from ssa_nerfstudio.errors import InputError

_MAX_FLOAT32 = 3.4e38


@dataclass
class Command:
    """Write a run's clean splats as PLY: the bytes of `ns-export gaussian-splat`, without photos and much faster."""

    load_config: Path
    """The run's config.yml (ssa-splatfacto or splatfacto), wherever its folder is now; no photos or GPU are needed."""
    output_dir: Path
    """Folder to write into; made where missing."""
    output_filename: str = "splat.ply"
    """Name of the PLY file; an older one is replaced."""
    ply_color_mode: Literal["sh_coeffs", "rgb"] = "sh_coeffs"
    """Colors as spherical harmonics, or as 8-bit red, green and blue."""
    compressed: bool = False
    """Also write PlayCanvas' compressed PLY (about a quarter of the size, lossy) as NAME.compressed.ply."""
    obb_center: tuple[float, float, float] | None = None
    """Center of a box outside of which nothing is exported; needs all three."""
    obb_rotation: tuple[float, float, float] | None = None
    """The box's roll, pitch and yaw, radians."""
    obb_scale: tuple[float, float, float] | None = None
    """The box's sizes."""
    step: int | None = None
    """Checkpoint to read; the newest where not given."""

    def run(self) -> None:
        """Read the checkpoint and write.

        Raises:
            InputError: an option or the checkpoint cannot be used.
        """
        box = self.obb_center, self.obb_rotation, self.obb_scale
        if any(box) and not all(box):
            raise InputError("a box needs all of --obb-center, --obb-rotation and --obb-scale")
        for name in ("obb_center", "obb_rotation", "obb_scale"):
            values = getattr(self, name) or ()
            if not all(abs(value) <= _MAX_FLOAT32 for value in values):
                raise InputError(f"--{name.replace('_', '-')} must be finite, got {values}")
        if min(self.obb_scale or (1,)) <= 0:
            raise InputError(f"--obb-scale must be positive, got {self.obb_scale}")
        if Path(self.output_filename).name != self.output_filename or not self.output_filename.endswith(".ply"):
            raise InputError(
                f"--output-filename {self.output_filename} must be the name of a .ply file, without folders"
            )

        from ssa_nerfstudio.data.writing import unwritable_as_input_error
        from ssa_nerfstudio.export.checkpoint import Checkpoint
        from ssa_nerfstudio.export.exposure_file import write_exposure
        from ssa_nerfstudio.export.splats import select, within, write_compressed_ply, write_ply

        checkpoint = Checkpoint.read(self.load_config, self.step)
        gaussians = checkpoint.gaussians()
        inside = within(gaussians, *box) if all(box) else None  # pyright: ignore[reportArgumentType]
        if inside is not None and not inside.any():
            raise InputError(f"no Gaussian of {len(inside)} is in the box", "choose another center, or larger sizes")
        selection = select(gaussians, inside)
        path = self.output_dir / self.output_filename
        console = plain_console()
        with unwritable_as_input_error(path):
            exposure = write_exposure(checkpoint, self.output_dir)
            write_ply(path, gaussians, selection.kept, self.ply_color_mode)
            paths = [path]
            if self.compressed:
                paths.append(path.with_suffix(".compressed.ply"))
                write_compressed_ply(paths[1], gaussians, selection.kept)
        for written in paths:
            console.print(f"{written}: {selection.kept.sum():,} Gaussians, {written.stat().st_size / 1e6:,.1f} MB")
        if exposure is not None:
            console.print(f"{exposure}: each photo's gain and offset; the splats are at the mean exposure")
        if selection.not_finite or selection.too_faint:
            console.print(
                f"Left out: {selection.too_faint:,} below an opacity of 1/255, {selection.not_finite:,} not finite."
            )
