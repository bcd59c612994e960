"""`ssa simulate`."""

from __future__ import annotations

import dataclasses
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio._system.counted_noun import counted
from ssa_nerfstudio._system.terminal_messages import plain_console
from ssa_nerfstudio.cli.option_bounds import Count, at_least
from ssa_nerfstudio.errors import InputError


@dataclass
class Command:
    """Add an artifact to the training photos of a nerfstudio dataset; test photos stay clean."""

    output: Path
    """Dataset to write; must not exist."""
    data: Path | None = None
    """Dataset to read: the folder with transforms.json, or the .json file; the built-in scene where it is left out."""
    effects: tuple[str, ...] | None = None
    """From the scene outwards: watermark, ui, dashboard, rain, mud, finger, occlusion, vignette, dust, their variants
    by name, or .yaml files. `--effects` without a value copies the dataset and adds the split."""
    scene: str | None = None
    """A scene instead: name or .yaml file; the scene.yaml of an earlier run repeats its effects."""
    seed: Annotated[int | None, at_least(0)] = None
    """Decides everything random, not negative; by default the scene's own, or 0."""
    exposure: float | None = None
    """Each training photo gets a gain and an offset of its own: standard deviation of the gains' logarithm, in [0, 1];
    by default the scene's own, or 0. It acts on what is on the lens, and not on what software drew (watermark, ui)."""
    eval_interval: Annotated[int, at_least(2)] = 8
    """One photo in so many, in sorted order, is for testing; ignored where transforms.json has a split."""
    downscale_factor: Count = 1
    """Read the photos from images_N and write a dataset of that size."""
    threads: Count = field(default_factory=usable_cores)
    """Photos in flight at once."""

    def run(self) -> None:
        """Simulate, and print the next step.

        Raises:
            InputError: the arguments, the dataset or a configuration cannot be used.
        """

        import tempfile

        from ssa_nerfstudio.data.dataset import Dataset
        from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene
        from ssa_nerfstudio.experiments.simulation.scene import MAX_EXPOSURE, Scene, read_effects, read_scene
        from ssa_nerfstudio.experiments.simulation.simulator import simulate

        if (self.effects is None) == (self.scene is None):
            raise InputError("give either --effects NAME ... or --scene NAME")
        if self.data is None and self.downscale_factor != 1:
            raise InputError("--downscale-factor is for the photos of --data", "add --data, or leave it out")
        scene = Scene(read_effects(self.effects)) if self.effects is not None else read_scene(str(self.scene))
        if self.seed is not None:
            scene = dataclasses.replace(scene, seed=self.seed)
        if self.exposure is not None:
            if not 0 <= self.exposure <= MAX_EXPOSURE:
                raise InputError(f"--exposure must be in [0, {MAX_EXPOSURE}], got {self.exposure}")
            scene = dataclasses.replace(scene, exposure=self.exposure)
        with tempfile.TemporaryDirectory() as scratch:
            data, name = self.data, None
            if data is None:
                data, name = Path(scratch) / "scene", "the built-in scene"
                DemoScene().write(data, artifact=None)
            dataset = Dataset.read(data, self.eval_interval, self.downscale_factor)
            simulate(dataset, scene, self.output, self.threads, name)

        train, _, test = dataset.split
        console = plain_console()
        console.print(
            f"{self.output}: {counted(len(train), 'training photo')}, {counted(len(test), 'clean test photo')}"
        )
        data, out = (shlex.quote(str(path)) for path in (self.output, self.output.with_name(f"{self.output.name}-run")))
        console.print(f"Make splats of it: ssa run {data} --output {out}")
