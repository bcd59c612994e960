"""What intervals gain: the built-in scene, half of it behind an artifact: `python benchmarks/interval_training.py`"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.effects.catalogue import effect_class
from ssa_nerfstudio.experiments.effects.layers import Layers
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene


def write_scene(folder: Path, effect: str, views: int, width: int, height: int) -> None:
    """Write the built-in scene with an effect in front of the second half of its training photos."""
    DemoScene(views=views, width=width, height=height).write(folder, None)
    layers = effect_class(effect)().layers(height, width, np.random.default_rng(0))
    if not isinstance(layers, Layers):
        raise InputError(f"{effect} varies from view to view", "choose another effect")
    for name in sorted(json.loads((folder / "transforms.json").read_text())["train_filenames"])[views // 2 :]:
        photo = np.asarray(Image.open(folder / name), np.float32) / 255
        behind = (layers.transmittance * photo + layers.addition).clip(0, 1)
        Image.fromarray(np.rint(behind * 255).astype(np.uint8)).save(folder / name)


@dataclass
class Command:
    """Train with one overlay for all photos, and with one for each interval; PSNR of clean test views."""

    effects: tuple[str, ...] = ("dashboard", "ui")
    """Effects, each alone, in front of the second half of the photos."""
    views: int = 40
    """Training photos."""
    width: int = 96
    height: int = 72
    steps: int = 600
    """Of each training."""

    def run(self) -> None:
        """Print a Markdown table row by row."""
        print("| effect in the second half | overlay-intervals off, dB | auto, dB |\n|---|---|---|")
        for effect in self.effects:
            with tempfile.TemporaryDirectory() as folder:
                write_scene(Path(folder) / "scene", effect, self.views, self.width, self.height)
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
