"""Error of a learned artifact against the true one: `python benchmarks/artifact_accuracy.py`

The built-in scene is trained behind a dashboard and behind a watermark; the artifact is exported as a user would, and
the files are compared with the artifact that was drawn.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ssa_nerfstudio.cli import run_script
from ssa_nerfstudio.cli.export_overlay import Command as ExportOverlay
from ssa_nerfstudio.cli.option_bounds import Count
from ssa_nerfstudio.experiments.simulation.built_in_scene import DemoScene


@dataclass
class Command:
    """Print the errors of matte, color and composite, for each artifact of the demo."""

    steps: Count = 600
    """Training steps."""

    def run(self) -> None:
        """Train, export, compare, print."""
        from ssa_nerfstudio.experiments.demo.comparison import ARTIFACTS, SMALL_SCENE
        from ssa_nerfstudio.experiments.runs.run_configuration import configure
        from ssa_nerfstudio.experiments.runs.training_run import train_and_evaluate

        scene = DemoScene()
        for name, artifact in ARTIFACTS.items():
            truth = artifact().layers(scene.height, scene.width, np.random.default_rng(0))
            with tempfile.TemporaryDirectory() as scratch:
                data = Path(scratch) / name
                scene.write(data, truth)
                config = configure("ssa-splatfacto", data, Path(scratch), self.steps, SMALL_SCENE)
                _, _, path = train_and_evaluate(config)
                ExportOverlay(path, Path(scratch) / "out").run()
                image = cv2.imread(str(Path(scratch) / "out" / "overlay_16bit.png"), cv2.IMREAD_UNCHANGED)
            assert image is not None
            learned = cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA) / 65535
            alpha = learned[..., 3:]
            matte = np.abs(alpha[..., 0] - truth.matte)
            inside = truth.matte > 0.1
            color = 255 * np.abs(learned[..., :3] - truth.addition / np.maximum(truth.matte, 1e-3)[..., None])[inside]
            clean = scene.render(scene.cameras[1][0]).astype(float)
            laid = 255 * alpha * learned[..., :3] + (1 - alpha) * clean
            picture = np.abs(laid - truth.apply(clean.astype(np.uint8)))
            print(
                f"{name}: matte {matte.mean():.4f} mean, {np.percentile(matte, 99):.3f} 99th percentile; color where "
                f"it covers {color.mean():.1f}, {np.percentile(color, 99):.1f} gray levels; laid over a clean photo "
                f"{picture.mean():.2f}, {np.percentile(picture, 99):.1f} gray levels"
            )


if __name__ == "__main__":
    run_script(Command)
