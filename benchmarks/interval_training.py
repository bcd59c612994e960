"""What intervals gain: the built-in scene, half of it behind an artifact: `python benchmarks/interval_training.py`"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from PIL import Image

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.option_bounds import Count, at_least
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene
from ssa_nerfstudio.experiments.simulation.scene import read_effects


def layers_of(effect: str, width: int, height: int) -> Layers:
    """Draw an effect.

    Raises:
        InputError: there is no such effect, or it varies from view to view.
    """
    ((_, parameters),) = read_effects((effect,))
    layers = parameters.layers(height, width, np.random.default_rng(0))
    if not isinstance(layers, Layers):
        raise InputError(f"--effects: {effect} varies from view to view", "choose another effect")
    return layers


def write_scene(folder: Path, layers: Layers, views: int, width: int, height: int) -> None:
    """Write the built-in scene with an artifact in front of the second half of its training photos."""
    DemoScene(views=views, width=width, height=height).write(folder, None)
    for name in sorted(json.loads((folder / "transforms.json").read_text())["train_filenames"])[views // 2 :]:
        photo = np.asarray(Image.open(folder / name), np.float32) / 255
        behind = (layers.transmittance * photo + layers.addition).clip(0, 1)
        Image.fromarray(np.rint(behind * 255).astype(np.uint8)).save(folder / name)


@dataclass
class Command:
    """Train with one overlay for all photos, and with one for each interval; PSNR of clean test views."""

    effects: tuple[str, ...] = ("dashboard", "ui")
    """Effects, each alone, in front of the second half of the photos."""
    views: Annotated[int, at_least(2)] = 40
    """Training photos."""
    width: Count = 96
    """Of a photo, pixels."""
    height: Count = 72
    """Of a photo, pixels."""
    steps: Count = 600
    """Of each training."""

    def run(self) -> None:
        """Print a Markdown table row by row.

        Raises:
            InputError: an effect cannot be used.
        """
        drawn = {effect: layers_of(effect, self.width, self.height) for effect in self.effects}
        print("| effect in the second half | overlay-intervals off, dB | auto, dB |\n|---|---|---|")
        for effect, layers in drawn.items():
            with tempfile.TemporaryDirectory() as folder:
                write_scene(Path(folder) / "scene", layers, self.views, self.width, self.height)
                values = [self._psnr(Path(folder), setting) for setting in ("off", "auto")]
            print(f"| {effect} | " + " | ".join(f"{value:.2f}" for value in values) + " |", flush=True)

    def _psnr(self, folder: Path, setting: str) -> float:
        from ssa_nerfstudio.experiments.runs.run_configuration import configure
        from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate

        model = {"overlay_intervals": setting, "num_downscales": 0}
        config = configure("ssa-splatfacto", folder / "scene", folder / setting, self.steps, model)
        return train_and_evaluate(config)[0].metrics["psnr"]


if __name__ == "__main__":
    run_script(Command)
