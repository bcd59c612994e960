"""`ssa simulate`."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

from ssa_nerfstudio.errors import InputError


@dataclass
class Command:
    """Add an artifact to the training photos of a nerfstudio dataset; test photos stay clean."""

    data: Path
    """Dataset to read: the folder with transforms.json, or the .json file."""
    output: Path
    """Dataset to write; must not exist."""
    effects: tuple[str, ...] | None = None
    """From the scene outwards: watermark, ui, dashboard, rain, mud, finger, occlusion, vignette, dust, their variants
    by name, or .yaml files. `--effects` without a value copies the dataset and adds the split."""
    scene: str | None = None
    """A scene instead: name or .yaml file; the scene.yaml of an earlier run repeats its effects."""
    seed: int | None = None
    """Decides everything random, not negative; by default the scene's own, or 0."""
    eval_interval: int = 8
    """One photo in so many, in sorted order, is for testing; ignored where transforms.json has a split."""
    downscale_factor: int = 1
    """Read the photos from images_N and write a dataset of that size."""
    threads: int = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    """Photos in flight at once."""

    def run(self) -> None:
        """Simulate, and print the next step.

        Raises:
            InputError: the arguments, the dataset or a configuration cannot be used.
        """
        from rich.console import Console

        from ssa_nerfstudio.data.dataset import Dataset
        from ssa_nerfstudio.experiments.simulation.scene import Scene, read_effects, read_scene
        from ssa_nerfstudio.experiments.simulation.simulator import simulate

        if (self.effects is None) == (self.scene is None):
            raise InputError("give either --effects NAME ... or --scene NAME")
        for name, lowest in (("seed", 0), ("threads", 1), ("eval_interval", 2), ("downscale_factor", 1)):
            if (value := getattr(self, name)) is not None and value < lowest:
                raise InputError(f"--{name.replace('_', '-')} must be at least {lowest}, got {value}")
        scene = Scene(read_effects(self.effects)) if self.effects is not None else read_scene(str(self.scene))
        if self.seed is not None:
            scene = dataclasses.replace(scene, seed=self.seed)
        dataset = Dataset.read(self.data, self.eval_interval, self.downscale_factor)
        simulate(dataset, scene, self.output, self.threads)

        train, _, test = dataset.split
        console = Console(highlight=False, soft_wrap=True)
        console.print(f"{self.output}: {len(train)} training photos, {len(test)} clean test photos")
        console.print(f"Train on it: ns-train ssa-splatfacto --data {self.output}")
