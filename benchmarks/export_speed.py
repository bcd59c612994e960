"""Seconds to write a PLY of many Gaussians, by nerfstudio's exporter and by ours: `python benchmarks/export_speed.py`

Both write the same values from memory; a million Gaussians take three minutes.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.export.splats import properties, select, write_compressed_ply, write_ply


@dataclass
class Command:
    """Write the same Gaussians with both exporters and compare time and bytes."""

    output: Path
    """Folder for the three files."""
    gaussians: Count = 1_000_000
    """Number of Gaussians, each of 62 values (third-degree spherical harmonics)."""

    def run(self) -> None:
        """Measure and print."""
        from nerfstudio.scripts.exporter import ExportGaussianSplat

        self.output.mkdir(parents=True, exist_ok=True)
        generator = torch.Generator().manual_seed(0)
        shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (1,), "features_dc": (3,)}
        shapes |= {"features_rest": (15, 3)}
        values = {name: torch.randn(self.gaussians, *shape, generator=generator) for name, shape in shapes.items()}
        kept = np.ones(self.gaussians, dtype=bool)
        seconds = {}

        start = time.perf_counter()
        theirs = OrderedDict(
            (name, block[:, number, None])
            for names, block in properties(values, kept, "sh_coeffs")
            for number, name in enumerate(names)
        )
        ExportGaussianSplat.write_ply(str(self.output / "nerfstudio.ply"), self.gaussians, theirs)
        seconds["nerfstudio"] = time.perf_counter() - start

        start = time.perf_counter()
        write_ply(self.output / "ours.ply", values, select(values).kept)
        seconds["ours"] = time.perf_counter() - start

        start = time.perf_counter()
        write_compressed_ply(self.output / "ours.compressed.ply", values, select(values).kept)
        seconds["compressed"] = time.perf_counter() - start

        sizes = {path.name: path.stat().st_size for path in self.output.glob("*.ply")}
        same = (self.output / "nerfstudio.ply").read_bytes() == (self.output / "ours.ply").read_bytes()
        print(f"seconds: { {name: round(value, 2) for name, value in seconds.items()} }")
        print(f"{seconds['nerfstudio'] / seconds['ours']:.1f} times faster; same bytes: {same}; sizes: {sizes}")


if __name__ == "__main__":
    run_script(Command)
